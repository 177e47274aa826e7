"""Contact sheets: pictures in rows and columns."""

from __future__ import annotations

import numpy as np


def grid(rows: list[list[np.ndarray]], *, gap: int = 4, background: float = 1.0) -> np.ndarray:
    """Rows of pictures [h, w, 3 or 4] in [0, 1] -> one float32 [H, W, 4], opaque.

    Pictures with alpha stand over the background; each cell has the size of the largest picture.
    """
    height = max(picture.shape[0] for row in rows for picture in row)
    width = max(picture.shape[1] for row in rows for picture in row)
    columns = max(len(row) for row in rows)
    shape = (len(rows) * (height + gap) + gap, columns * (width + gap) + gap, 4)
    sheet = np.full(shape, background, np.float32)
    sheet[..., 3] = 1
    for r, row in enumerate(rows):
        for c, picture in enumerate(row):
            top, left = gap + r * (height + gap), gap + c * (width + gap)
            colour = picture[..., :3]
            if picture.shape[2] == 4:
                colour = colour * picture[..., 3:] + background * (1 - picture[..., 3:])
            sheet[top : top + picture.shape[0], left : left + picture.shape[1], :3] = colour
    return sheet


def error_map(picture: np.ndarray, truth: np.ndarray, *, full: float = 0.25) -> np.ndarray:
    """Mean absolute error of pictures [H, W, 3]: black, red, yellow, and white from `full` on."""
    error = np.clip(np.abs(picture - truth).mean(-1) / full, 0, 1)
    return np.clip(3 * error[..., None] - np.arange(3), 0, 1).astype(np.float32)
