"""A textured mesh of an avatar, for programs that cannot run its field."""

from .bake import Baked, bake
from .fidelity import Likeness, compare
from .gltf import write_glb

__all__ = ["Baked", "Likeness", "bake", "compare", "write_glb"]
