"""Head models: the built-in one, files, any mesh with shape keys; posing and skinning."""

from .builtin import BUILTIN, builtin_head
from .files import read_head, write_head
from .library import load_head, remember_head, remembered_head
from .model import HeadModel
from .shape_keys import head_from_shape_keys

__all__ = [
    "BUILTIN",
    "HeadModel",
    "builtin_head",
    "head_from_shape_keys",
    "load_head",
    "read_head",
    "remember_head",
    "remembered_head",
    "write_head",
]
