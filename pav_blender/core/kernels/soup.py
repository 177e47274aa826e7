"""What the kernel of solids takes. No torch here: Blender's side holds these without it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Soup:
    """Triangles of O objects in their own spaces. vertices [V, 3] float32, owner [V] int32 (the
    object), triangles [T, 3] int32, normals [N, 3] float32 of any length, normal_of [T, 3] int32
    (each corner's), material [T] int32 (the row of a palette)."""

    vertices: np.ndarray
    owner: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray
    normal_of: np.ndarray
    material: np.ndarray


@dataclass(frozen=True, eq=False)
class Lights:
    """directions [L, 3] float64: towards each light in the camera's axes, as long as it is strong;
    ambient: what comes from everywhere."""

    directions: np.ndarray
    ambient: float
