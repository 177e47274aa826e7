"""Axes of the core (+y up, face toward +z) and of Blender (+z up, face toward -y).

A point (x, y, z) of the core is (x, -z, y) in Blender. Cameras of the core look along +z with y
down (OpenCV), Blender's look along -z with y up.
"""

from __future__ import annotations

import numpy as np

TO_BLENDER = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
TO_CORE = TO_BLENDER.T.copy()
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def points_to_blender(points: np.ndarray) -> np.ndarray:
    """[..., 3] core -> Blender, same dtype, contiguous."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def points_to_core(points: np.ndarray) -> np.ndarray:
    """[..., 3] Blender -> core, same dtype, contiguous."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def matrix_to_core(matrix: np.ndarray) -> np.ndarray:
    """A transform [4, 4] of Blender points -> the same transform of core points."""
    return TO_CORE @ matrix @ TO_BLENDER


def camera_to_blender(camera_to_world: np.ndarray) -> np.ndarray:
    """Core camera_to_world [4, 4] -> `matrix_world` of Blender's camera, float64."""
    return TO_BLENDER @ np.asarray(camera_to_world, np.float64) @ _FLIP


def camera_to_core(matrix_world: np.ndarray) -> np.ndarray:
    """`matrix_world` of a Blender camera -> core camera_to_world [4, 4]; scale is dropped, as
    Blender drops it when it renders."""
    matrix = TO_CORE @ np.asarray(matrix_world, np.float64) @ _FLIP
    matrix[:3, :3] /= np.linalg.norm(matrix[:3, :3], axis=0)
    return matrix
