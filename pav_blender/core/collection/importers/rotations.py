"""Rotations as trackers write them, to axis-angle."""

from __future__ import annotations

import numpy as np

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # between cameras of OpenCV's axes and OpenGL's


def matrix_of_6d(six: np.ndarray) -> np.ndarray:
    """[..., 6] -> [..., 3, 3]: the first two ROWS, made orthonormal (as PyTorch3D does)."""
    first, second = six[..., :3], six[..., 3:]
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    second = second - (first * second).sum(-1, keepdims=True) * first
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], -2)


def axis_angle(matrix: np.ndarray) -> np.ndarray:
    """[3, 3] -> [3], radians; what is not finite stays so."""
    from scipy.spatial.transform import Rotation

    if not np.isfinite(matrix).all():
        return np.full(3, np.nan)
    return Rotation.from_matrix(matrix).as_rotvec()


def axis_angle_of_6d(six: np.ndarray) -> np.ndarray:
    """[6] -> [3], radians; not finite where the six numbers make no rotation."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return axis_angle(matrix_of_6d(np.asarray(six, np.float64)))


def matrices(turns: np.ndarray) -> np.ndarray:
    """Axis-angle [F, 3] -> [F, 3, 3]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(turns).as_matrix()
