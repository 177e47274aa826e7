"""Head models: the built-in one, files, any mesh with shape keys; posing and skinning."""

from .builtin import BUILTIN, builtin_head, load_head
from .files import read_head, write_head
from .model import HeadModel

__all__ = ["BUILTIN", "HeadModel", "builtin_head", "load_head", "read_head", "write_head"]
