"""Which pixels of a picture are traced: one that lies between four that agree is their mean.

Every second pixel of every second row comes first, then those in the middle of four, then the rest,
so that each is held against its nearest neighbours on all sides. One in five of the second kind is
traced in any case, spread so that no row, column or diagonal goes without: where one of these is
not what its neighbours promise, all around it are traced, and lines finer than a pixel are not
lost between those that came first.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .. import kernels
from ..kernels.reference.sparing import lattice

_DIAGONAL = 0.6  # of what neighbours may differ by, for those that are further apart
_AROUND = 2  # pixels of the second kind that are traced on each side of a surprise
_CORNERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))
_SIDES = ((-1, 0), (1, 0), (0, -1), (0, 1))


def passes(
    rgba: np.ndarray, depth: np.ndarray, limit: np.ndarray | None, agreement: float
) -> Iterator[np.ndarray]:
    """Masks [H, W] of what is to be traced next, into straight rgba [H, W, 4] and depth [H, W]
    (metres, infinite where there is nothing); what is in none of them is filled in here.

    limit [H, W]: how far each pixel sees. agreement: the most by which neighbours may differ, in
    any of the premultiplied colours and alpha from 0 to 1; at 0 every pixel is traced.
    """
    shape = depth.shape
    if agreement <= 0 or min(shape) < 3:
        yield np.ones(shape, bool)
        return
    first = np.zeros(shape, bool)
    first[::2, ::2] = True
    middles = first[1::2, 1::2]
    row, column = np.ogrid[: middles.shape[0], : middles.shape[1]]
    middles |= (row + 2 * column) % 5 == 0
    yield first

    fill = kernels.select("cpu").sparing.fill
    free = ~lattice(first, 1, 1)
    free &= ~_grown(_surprises(rgba, ~free, _DIAGONAL * agreement))
    second = np.zeros(shape, bool)
    second[1::2, 1::2] = True
    second &= ~first
    filled = fill(rgba, depth, limit, (1, 1), _CORNERS, _DIAGONAL * agreement, free)
    lattice(second, 1, 1)[filled] = False
    yield second

    third = np.zeros(shape, bool)
    third[::2, 1::2] = third[1::2, ::2] = True
    for corner in ((2, 1), (1, 2)):
        free = np.ones(lattice(third, *corner).shape, bool)
        filled = fill(rgba, depth, limit, corner, _SIDES, agreement, free)
        lattice(third, *corner)[filled] = False
    yield third


def _surprises(rgba: np.ndarray, probes: np.ndarray, agreement: float) -> np.ndarray:
    """Which probes, pixels in the middle of four, are not about the mean of these."""
    row, column = np.nonzero(probes)
    row, column = 2 * row + 1, 2 * column + 1

    def colour(down: int, right: int) -> np.ndarray:
        found = rgba[row + down, column + right]
        found[:, :3] *= found[:, 3:]
        return found

    mean = sum(colour(*step) for step in _CORNERS) / len(_CORNERS)
    surprises = np.zeros_like(probes)
    surprises[probes] = ~(np.abs(colour(0, 0) - mean).max(-1) < agreement)
    return surprises


def _grown(mask: np.ndarray) -> np.ndarray:
    """What lies within `_AROUND` of a mask, in both directions."""
    for axis in (0, 1):
        wide = mask.copy()
        for step in range(1, _AROUND + 1):
            ahead, behind = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], behind[axis] = slice(step, None), slice(None, -step)
            wide[tuple(ahead)] |= mask[tuple(behind)]
            wide[tuple(behind)] |= mask[tuple(ahead)]
        mask = wide
    return mask
