"""The head's own axes in a posed mesh: the rotation that view directions are measured in."""

from __future__ import annotations

import numpy as np

_END = 0.8  # part of the mesh that is nearer to the skull than what it is turned against


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


def head_turn(
    canonical: np.ndarray, posed: np.ndarray, weights: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """How the skull, turned by `rotation` (`head_rotation`'s), is turned against the shoulders, or
    whatever the mesh ends in: axis times sine of the angle, [3] float32, in canonical axes."""
    skull = (weights[:, None] * canonical).sum(0) / max(float(weights.sum()), 1e-12)
    away = np.linalg.norm(canonical - skull, axis=1)
    end = (away >= np.quantile(away, _END)).astype(np.float32)
    turned = head_rotation(canonical, posed, end).T @ rotation
    skew = turned - turned.T
    return (np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / 2).astype(np.float32)
