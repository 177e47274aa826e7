"""Whose head the studio films: one face picked by eye, varied a little by the seed."""

from __future__ import annotations

import numpy as np

from ..core.head import HeadModel

# Coefficients of the built-in head: a young man drawn from MakeHuman's sliders (high cheek bones,
# open eyes, fuller lips, a slightly uneven nose and mouth), projected onto the identity basis.
FACE = (
    0.77, 0.45, 0.42, 0.32, 0.79, -0.58, 0.56, -2, 0.68, -0.68, 0.5, -1.66, -1.1, 0.06, -1.99,
    -1.19, -0.11, 0.39, -0.03, -0.21, 0.04, 0.73, 0.13, 1.36, -1.66, 0.64, -0.64, -1.57, -0.64,
    -1.35, -2.11, -0.57, 0.11, -2.11, 0.24, 0.38, 0.16, 1.29, -1.54, 1.02, 0.14, 0.65, 1.14,
    -1.05, 1.06, 1.57, -0.35, 0.11, -1.02, -0.64, -1.19, -0.6, -1.05, -1.48, 1.45, -1.6, 0.94,
    -0.81, 0.8, -1.57, 2.29, -0.29, 1.74, 0.15,
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
