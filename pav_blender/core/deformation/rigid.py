"""How a posed mesh stands: the head's own axes, that view directions are measured in, and the
shoulders, that do not turn with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

_END = 0.8  # part of the mesh that is nearer to the skull than what it is turned against


def head_rotation(canonical: np.ndarray, posed: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Rotation [3, 3], float32, that best turns the canonical mesh [V, 3] into the posed one.

    Weighted least squares (Kabsch 1976), so it follows any deformer, not only an armature.
    weights [V] say which vertices move rigidly with the skull.
    """
    w = weights.astype(np.float64) / max(float(weights.sum()), 1e-12)
    a, b = (np.ascontiguousarray(mesh.T, np.float64) for mesh in (canonical, posed))
    a, b = a - (a @ w)[:, None], b - (b @ w)[:, None]
    u, _, vt = np.linalg.svd((w * b) @ a.T)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    return (u @ flip @ vt).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Stance:
    """How a posed mesh stands: rotation [3, 3], the head's; turn [3], axis times sine of how the
    skull is turned against the shoulders, or whatever the mesh ends in, in canonical axes. A posed
    point x lies at `x @ shoulders + offset` ([3, 3], [3]) where the shoulders do not move."""

    rotation: np.ndarray
    turn: np.ndarray
    shoulders: np.ndarray
    offset: np.ndarray

    def still(self, points: torch.Tensor) -> torch.Tensor:
        """Posed points [N, 3] carried along with the shoulders to the canonical mesh's."""
        return points @ torch.from_numpy(self.shoulders) + torch.from_numpy(self.offset)


def stance(canonical: np.ndarray, posed: np.ndarray, weights: np.ndarray) -> Stance:
    """Of a mesh [V, 3] posed; weights [V] as in `head_rotation`."""
    rotation = head_rotation(canonical, posed, weights)
    skull = (weights[:, None] * canonical).sum(0) / max(float(weights.sum()), 1e-12)
    away = np.linalg.norm(canonical - skull, axis=1)
    end = (away >= np.quantile(away, _END)).astype(np.float32)
    shoulders = head_rotation(canonical, posed, end)
    turned = shoulders.T @ rotation
    skew = turned - turned.T
    turn = (np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / 2).astype(np.float32)
    rows = end > 0
    offset = canonical[rows].mean(0) - posed[rows].mean(0) @ shoulders
    return Stance(rotation, turn, shoulders, offset.astype(np.float32))
