"""From the posed mesh to the canonical one: triangle maps, the deformer, the clearance grid."""

from ..kernels.reference.frames import triangle_maps, vertex_maps
from ..kernels.reference.marching import canonicalise
from ..kernels.structures import Clearance, PosedMesh, Thrift, Voxels, Wave
from .deformer import Deformer
from .occupancy import clearance
from .voxels import voxels

__all__ = [
    "Clearance",
    "Deformer",
    "PosedMesh",
    "Thrift",
    "Voxels",
    "Wave",
    "canonicalise",
    "clearance",
    "triangle_maps",
    "vertex_maps",
    "voxels",
]
