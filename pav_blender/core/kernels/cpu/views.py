"""What the directions of rays add to a network's first layer; the harmonics are those of
`field/directions.py`."""

from __future__ import annotations

import numpy as np
import torch
from numba import njit

from .lanes import LANES, fma, load, splat, store
from .marching import rows_of
from .search import LEAN, OPTIONS

HARMONICS = 16


def views_of(directions: torch.Tensor, rotation: torch.Tensor, view: torch.Tensor) -> np.ndarray:
    """Unit directions [R, 3], turned by `directions @ rotation` ([3, 3]), as harmonics times view
    [16, hidden]: [R, hidden], with zeros up to the next whole vector; on this thread alone."""
    hidden = view.shape[1]
    wide = hidden + -hidden % LANES
    padded = np.zeros((HARMONICS, wide), np.float32)
    padded[:, :hidden] = view.numpy()
    out = np.empty((len(directions), wide), np.float32)
    turn = rows_of(rotation, np.float32)
    _views(rows_of(directions, np.float32), turn, padded.reshape(-1), out.reshape(-1))
    return out


@njit(**LEAN)
def _harmonics(x, y, z, out):
    xx, yy, zz = x * x, y * y, z * z
    xy, yz, xz = x * y, y * z, x * z
    one, three, five = np.float32(1), np.float32(3), np.float32(5)
    out[0] = np.float32(0.28209479)
    out[1] = np.float32(-0.48860251) * y
    out[2] = np.float32(0.48860251) * z
    out[3] = np.float32(-0.48860251) * x
    out[4] = np.float32(1.09254843) * xy
    out[5] = np.float32(-1.09254843) * yz
    out[6] = np.float32(0.94617470) * zz - np.float32(0.31539157)
    out[7] = np.float32(-1.09254843) * xz
    out[8] = np.float32(0.54627422) * (xx - yy)
    out[9] = np.float32(-0.59004359) * y * (three * xx - yy)
    out[10] = np.float32(2.89061144) * xy * z
    out[11] = np.float32(-0.45704580) * y * (five * zz - one)
    out[12] = np.float32(0.37317633) * z * (five * zz - three)
    out[13] = np.float32(-0.45704580) * x * (five * zz - one)
    out[14] = np.float32(1.44530572) * z * (xx - yy)
    out[15] = np.float32(-0.59004359) * x * (xx - three * yy)


@njit(**OPTIONS)
def _views(directions, turn, view, out):
    wide = len(view) // HARMONICS
    found, turned = np.empty(HARMONICS, np.float32), np.empty(3, np.float32)
    for ray in range(len(directions)):
        for axis in range(3):
            turned[axis] = (
                directions[ray, 0] * turn[0, axis]
                + directions[ray, 1] * turn[1, axis]
                + directions[ray, 2] * turn[2, axis]
            )
        _harmonics(turned[0], turned[1], turned[2], found)
        for channel in range(0, wide, LANES):
            total = splat(0.0)
            for k in range(HARMONICS):
                total = fma(splat(found[k]), load(view, k * wide + channel), total)
            store(out, ray * wide + channel, total)
