"""Head models: the built-in one, files, any mesh with shape keys; posing and skinning."""

from pav_blender.core.head.builtin import BUILTIN, builtin_head, load_head
from pav_blender.core.head.files import read_head, write_head
from pav_blender.core.head.model import HeadModel

__all__ = ["BUILTIN", "HeadModel", "builtin_head", "load_head", "read_head", "write_head"]
