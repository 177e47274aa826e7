"""The clearance grid: how many cells away the nearest occupied one is."""

from __future__ import annotations

import numpy as np
from scipy import ndimage


def clearance(occupied: np.ndarray) -> np.ndarray:
    """Occupied [G,G,G] bool -> uint8: chessboard distance in cells to the nearest occupied one.

    0 in occupied cells, capped at 255; 255 everywhere when nothing is occupied.
    """
    occupied = np.asarray(occupied, bool)
    if not occupied.any():
        return np.full(occupied.shape, 255, np.uint8)
    distance = ndimage.distance_transform_cdt(~occupied, metric="chessboard")
    return np.minimum(distance, 255).astype(np.uint8)
