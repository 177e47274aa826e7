"""From the posed mesh to the canonical one: triangle maps, the deformer, the clearance grid."""

from ..kernels.reference.marching import canonicalise
from ..kernels.structures import Clearance, PosedMesh, Wave
from .deformer import Deformer
from .frames import triangle_maps, vertex_maps
from .occupancy import clearance
from .shells import box, shell

__all__ = [
    "Clearance",
    "Deformer",
    "PosedMesh",
    "Wave",
    "box",
    "canonicalise",
    "clearance",
    "shell",
    "triangle_maps",
    "vertex_maps",
]
