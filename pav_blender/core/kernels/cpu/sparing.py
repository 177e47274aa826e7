"""Pixels that need not be traced, compiled; see `reference/sparing.py`."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..reference.sparing import BEFORE, SURFACE, Steps, lattice
from .search import OPTIONS
from .threads import run_chunks

_ROWS = 32  # a thread takes at a time
_BEFORE, _SURFACE = np.float32(BEFORE), np.float32(SURFACE)


def fill(
    rgba: np.ndarray,
    depth: np.ndarray,
    limit: np.ndarray | None,
    corner: tuple[int, int],
    around: Steps,
    agreement: float,
    free: np.ndarray,
) -> np.ndarray:
    """As the reference."""
    filled = np.zeros(lattice(depth, *corner).shape, bool)
    sight = np.zeros((0, 0), np.float32) if limit is None else np.asarray(limit, np.float32)
    run_chunks(_fill, len(filled), _ROWS, rgba, depth, sight, *corner, np.array(around),
               np.float32(agreement), np.ascontiguousarray(free), filled)  # fmt: skip
    return filled


@njit(**OPTIONS)
def _fill(start, stop, rgba, depth, limit, top, left, around, agreement, free, filled):
    low, high, total = np.zeros(4, np.float32), np.zeros(4, np.float32), np.zeros(4, np.float32)
    infinite = np.float32(np.inf)
    count = np.float32(len(around))
    for i in range(start, stop):
        for j in range(filled.shape[1]):
            if not free[i, j]:
                continue
            row, column = top + 2 * i, left + 2 * j
            low[:], high[:], total[:] = infinite, -infinite, 0
            near, far, along, least = infinite, -infinite, np.float32(0), infinite
            for step in range(len(around)):
                r, c = row + around[step, 0], column + around[step, 1]
                alpha = rgba[r, c, 3]
                for channel in range(4):
                    value = rgba[r, c, channel] * alpha if channel < 3 else alpha
                    low[channel] = min(low[channel], value)
                    high[channel] = max(high[channel], value)
                    total[channel] += value
                near, far = min(near, depth[r, c]), max(far, depth[r, c])
                along += depth[r, c]
                if len(limit) > 0:
                    least = min(least, limit[r, c])
            differ = np.float32(0)
            for channel in range(4):
                differ = max(differ, high[channel] - low[channel])
            empty = near == infinite
            if not differ < agreement or not (empty or far - near < _SURFACE):
                continue
            if len(limit) > 0:
                own = limit[row, column]
                if empty and not own <= least:
                    continue
                if not empty and not min(own, least) > far + _BEFORE:
                    continue
            alpha = total[3] / count
            for channel in range(3):
                colour = total[channel] / count
                rgba[row, column, channel] = colour / alpha if alpha > 0 else np.float32(0)
            rgba[row, column, 3] = alpha
            depth[row, column] = along / count
            filled[i, j] = True


def cover(
    corners: np.ndarray, near: np.ndarray, far: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """As the reference."""
    least, most = np.full(shape, np.inf, np.float32), np.full(shape, -np.inf, np.float32)
    _cover(np.ascontiguousarray(corners, np.int64), near.astype(np.float32),
           far.astype(np.float32), least, most)  # fmt: skip
    return least, most


@njit(**OPTIONS)
def _cover(corners, near, far, least, most):
    for i in range(len(corners)):
        for row in range(corners[i, 1], corners[i, 3]):
            for column in range(corners[i, 0], corners[i, 2]):
                least[row, column] = min(least[row, column], near[i])
                most[row, column] = max(most[row, column], far[i])
