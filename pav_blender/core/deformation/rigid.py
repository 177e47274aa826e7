"""The head's own axes in a posed mesh: the rotation that view directions are measured in."""

from __future__ import annotations

import numpy as np


def head_rotation(canonical: np.ndarray, posed: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Rotation [3, 3], float32, that best turns the canonical mesh [V, 3] into the posed one.

    Weighted least squares (Kabsch 1976), so it follows any deformer, not only an armature.
    weights [V] say which vertices move rigidly with the skull.
    """
    total = max(float(weights.sum()), 1e-12)
    w = (weights / total).astype(np.float64)[:, None]
    a = canonical - (w * canonical).sum(0)
    b = posed - (w * posed).sum(0)
    u, _, vt = np.linalg.svd((w * b).T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    return (u @ flip @ vt).astype(np.float32)


def turn(rotation: np.ndarray) -> np.ndarray:
    """A rotation [3, 3] as its axis times the sine of its angle, [3] float32."""
    skew = rotation - rotation.T
    return (np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / 2).astype(np.float32)
