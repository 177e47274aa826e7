"""Whose head the studio films: one face picked by eye, varied a little by the seed."""

from __future__ import annotations

import numpy as np

from ..core.head import HeadModel

# Coefficients of the built-in head: a young man drawn from MakeHuman's sliders (high cheek bones,
# open eyes, fuller lips, a slightly uneven nose and mouth), projected onto the identity basis.
FACE = (
    0.75, 0.19, 0.27, 0.45, 0.56, -0.69, 0.62, 0.03, -1.35, -0.74, 0.46, 0.48, -0.79, -0.31,
    -1.22, -1.9, -0.08, -1.08, -0.06, -0.72, -0.46, 0.42, -0.78, 0.12, 1.13, -0.08, -0.77,
    -1.36, -1.68, -0.3, -0.93, -0.68, -0.47, -0.71, -0.42, 1.72, -0.06, -1.41, 0.21, 0.6, 0.1,
    0.31, 1.34, -0.99, -0.19, 0.63, 0.32, -0.33, 0.34, -0.97, 1.59, 0.64, -0.97, 1.47, -0.34,
    -1.23, -0.67, 1.56, -0.78, 0.57, -1.81, 0.88, 0.2, -1.32,
)  # fmt: skip


def identity(head: HeadModel, seed: int) -> np.ndarray:
    """Identity coefficients [B] of the person with this seed; seed 0 is the face as picked."""
    betas = np.zeros(len(head.shape_basis), np.float32)
    count = min(len(FACE), len(betas))
    betas[:count] = FACE[:count]
    if seed:
        rng = np.random.default_rng([seed, 20])
        betas[:count] = 0.8 * betas[:count] + 0.35 * rng.standard_normal(count)
    return betas
