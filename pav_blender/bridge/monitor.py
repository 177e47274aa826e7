"""Pictures of a training that the panel shows as icons: its curve, and what the avatar looks
like."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import PavError
from ..core.training.places import PICTURE
from .training import Watch
from .windows import show_as_icon

SIDE = 192  # pixels of the curve's picture: icons are square
_FINER = 3
_BACK, _GRID = (0.11, 0.11, 0.12), (0.2, 0.2, 0.22)
PSNR_COLOUR, LOSS_COLOUR = (0.35, 0.65, 1.0), (0.95, 0.6, 0.25)
_REFRESH_S = 1.0
_SMALL = 32


@dataclass
class Icons:
    """curve: an icon number, 0 for none; pictures: (filmed, avatar) an appearance."""

    curve: int = 0
    blue: int = 0  # the colours of the PSNR's line and the loss's
    orange: int = 0
    pictures: list[tuple[int, int]] = field(default_factory=list)


class _Shelf:
    """Previews that were made, replaced as a whole."""

    def __init__(self) -> None:
        import bpy.utils.previews

        self._previews = bpy.utils.previews.new()
        self._made = 0
        self.key: object = None
        self.icons: list[int] = []

    def replace(self, key: object, pictures: list[np.ndarray]) -> None:
        old = list(self._previews)
        self.icons = []
        for picture in pictures:
            self._made += 1
            preview = self._previews.new(f"pav{self._made}")
            show_as_icon(preview, picture, small=max(picture.shape) <= _SMALL)
            self.icons.append(preview.icon_id)
        for name in old:
            del self._previews[name]
        self.key = key

    def close(self) -> None:
        import bpy.utils.previews

        bpy.utils.previews.remove(self._previews)


_shelves: dict[str, _Shelf] = {}
_drawn_at = 0.0


def icons(watch: Watch) -> Icons:
    """The icons of a training as it stands; made anew only where something changed."""
    global _drawn_at
    if not _shelves:
        _shelves.update(curve=_Shelf(), pictures=_Shelf())
    curve, pictures = _shelves["curve"], _shelves["pictures"]
    key = (str(watch.wanted.output), len(watch.curve), watch.curve[-1:])
    if curve.key != key and time.monotonic() - _drawn_at > _REFRESH_S:
        _drawn_at = time.monotonic()
        swatches = [_swatch(colour) for colour in (PSNR_COLOUR, LOSS_COLOUR)]
        curve.replace(key, [curve_picture(watch.curve), *swatches])
    path = watch.wanted.preview / PICTURE
    try:
        stamp: Any = (str(path), path.stat().st_mtime_ns)
    except OSError:
        stamp = None
    if stamp is None:
        pictures.key, pictures.icons = None, []
    elif pictures.key != stamp:
        pictures.replace(stamp, pieces(path))
    shown = pictures.icons
    half = len(shown) // 2
    graph, blue, orange = curve.icons or (0, 0, 0)
    return Icons(graph, blue, orange, list(zip(shown[:half], shown[half:], strict=True)))


def forget() -> None:
    for shelf in _shelves.values():
        shelf.close()
    _shelves.clear()


def pieces(path: Path) -> list[np.ndarray]:
    """The squares of a preview picture: those filmed, then the avatar's; none if it is damaged."""
    from ..core.images import read_rgba

    try:
        picture = read_rgba(path).astype(np.float32) / 255
    except PavError:
        return []
    side = picture.shape[0] // 2
    columns = picture.shape[1] // max(side, 1)
    return [
        picture[row : row + side, column * side : (column + 1) * side]
        for row in (0, side)
        for column in range(columns)
    ]


def curve_picture(rows: list[tuple[float, ...]]) -> np.ndarray:
    """PSNR and loss (logarithmic) over iterations, [SIDE, SIDE, 4] in [0, 1]; empty axes
    where there are no two rows."""
    height = width = SIDE * _FINER
    canvas = np.empty((height, width, 3), np.float32)
    canvas[:] = _BACK
    for part in (0.25, 0.5, 0.75):
        canvas[int(part * height) : int(part * height) + 2] = _GRID
    if len(rows) > 1:
        table = np.array(rows)
        x = table[:, 0] / max(table[-1, 0], 1) * (width - 1)
        for values, colour in (
            (np.log10(np.maximum(table[:, 2], 1e-9)), LOSS_COLOUR),
            (table[:, 3], PSNR_COLOUR),
        ):
            _draw_line(canvas, x, values, colour)
    small = canvas.reshape(SIDE, _FINER, SIDE, _FINER, 3).mean((1, 3))
    return np.concatenate([small, np.ones((*small.shape[:2], 1), np.float32)], 2)


def _swatch(colour: tuple[float, float, float]) -> np.ndarray:
    """A short thick line, [_SMALL, _SMALL, 4]."""
    picture = np.zeros((_SMALL, _SMALL, 4), np.float32)
    picture[13:19, 4:28] = (*colour, 1)
    return picture


def _draw_line(
    canvas: np.ndarray, x: np.ndarray, values: np.ndarray, colour: tuple[float, float, float]
) -> None:
    """A line through points in order of x [N] (pixels), values scaled to the height."""
    height, width = canvas.shape[:2]
    low, high = float(values.min()), float(values.max())
    margin, half = 0.08 * height, 2 * _FINER // 2
    columns = np.arange(width)
    level = np.interp(columns, x, (values - low) / max(high - low, 1e-9))
    y = (height - 1 - margin - level * (height - 1 - 2 * margin)).astype(int)
    previous = np.concatenate([y[:1], y[:-1]])
    first = int(np.ceil(x[0]))
    for column in range(first, width):
        top, bottom = sorted((int(y[column]), int(previous[column])))
        canvas[max(top - half, 0) : bottom + half + 1, column] = colour
