"""How a training is going, for who watches: a small picture now and then, and its curve.

In a folder of its own lie `preview.png` (a column an appearance: the filmed picture above, the
avatar of this moment below) and `curve.json` (rows of COLUMNS). Both are whole at any time.
"""

from __future__ import annotations

import json
import math
import time
from itertools import zip_longest
from pathlib import Path

import numpy as np

from ..collection import Collection
from ..errors import InputError
from ..files import write_text
from ..images import write_rgba
from ..rendering.rays import camera_rays
from ..rendering.render import RenderSettings, trace_rays
from ..tracking.crop import resize
from .frames import Frame, load_frames
from .people import People
from .places import COLUMNS, CURVE, PICTURE, read_curve
from .trainer import Status, Trainer

SIDE = 160  # pixels of a picture
MOST_COLUMNS = 4
_NOTE_S = 2.0  # between two points of the curve
_EVERY_S = 20.0  # at least so long between two pictures,
_COST = 0.01  # and so long that they take no more than this part of the training
_GREY = 0.5  # what lies behind the person
_MOST_POINTS = 500  # of the curve


class Preview:
    """Shows `trainer`'s avatar beside frames that it does not learn from, where there are any."""

    def __init__(
        self, folder: Path | str, collection: Collection | People, trainer: Trainer
    ) -> None:
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot write there: {error.strerror}") from error
        self._trainer = trainer
        self._frames = _sights(collection)
        self._truth = [_on_grey(frame.rgba / np.float32(255)) for frame in self._frames]
        self._points = [
            point for point in read_curve(self.folder) if point[0] <= trainer.status.iteration
        ]
        self._due, self._noted, self._first = 0.0, 0.0, True
        self.seconds = 0.0  # that it took, all together

    def __call__(self, status: Status, *, last: bool = False) -> bool:
        """Notes where training stands; True where that was the moment for a new picture."""
        started = time.monotonic()
        if last or started - self._noted > _NOTE_S:
            self._note(status)
            self._noted = started
        if not last and started < self._due:
            return False
        self.keep_curve()
        pictures = [self._draw(frame) for frame in self._frames]
        rows = [np.concatenate(row, 1) for row in (self._truth, pictures)]
        write_rgba(self.folder / PICTURE, np.concatenate(rows))
        took = time.monotonic() - started
        self.seconds += took
        # the first may wait for the compiler: what others cost is not known by it
        cost = 0.0 if self._first else took
        self._due, self._first = time.monotonic() + max(_EVERY_S, cost / _COST), False
        return True

    def keep_curve(self) -> None:
        """Writes the curve so far; with a checkpoint, so that both are there to go on from."""
        write_text(self.folder / CURVE, json.dumps({"columns": COLUMNS, "rows": self._points}))

    def _note(self, status: Status) -> None:
        point = (status.iteration, round(status.seconds, 2), status.loss, status.psnr)
        if all(math.isfinite(value) for value in point):
            self._points.append(point)
        if len(self._points) > _MOST_POINTS:
            del self._points[1:-1:2]

    def _draw(self, frame: Frame) -> np.ndarray:
        camera = frame.camera.resized(SIDE, SIDE)
        columns, rows = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
        rays = camera_rays(camera, columns.ravel(), rows.ravel())
        settings = RenderSettings.preset("preview")
        rgba, _ = trace_rays(self._trainer.scene(frame), rays, settings)
        return _on_grey(rgba.reshape(SIDE, SIDE, 4))


def _sights(collection: Collection | People) -> list[Frame]:
    """A frame of each of the first appearances; people take turns."""
    if not isinstance(collection, People):
        return [_sight(collection, name) for name in collection.appearances[:MOST_COLUMNS]]
    people = collection.collections.items()
    turns = zip_longest(*([(n, c, look) for look in c.appearances] for n, c in people))
    shown = [place for turn in turns for place in turn if place is not None][:MOST_COLUMNS]
    return [collection.joined(name, _sight(own, look)) for name, own, look in shown]


def _sight(collection: Collection, appearance: str) -> Frame:
    """The middle held-out frame of an appearance, else its middle training frame, made square."""
    clips = [clip for clip in collection.clips if clip.appearance == appearance]
    for split in ("test", "train"):
        for clip in clips:
            rows = clip.indices(split)
            if len(rows):
                middle = rows[len(rows) // 2 : len(rows) // 2 + 1]
                return _square(load_frames(collection, clip, middle, targets=False)[0])
    raise InputError(f"{collection.path}: appearance {appearance!r} has no frames")


def _square(frame: Frame) -> Frame:
    """The largest square of a frame about its middle, or where the person is."""
    height, width = frame.rgba.shape[:2]
    side = min(height, width)
    rows, columns = np.nonzero(frame.rgba[..., 3] > 127)
    y, x = (rows.mean(), columns.mean()) if len(rows) else (height / 2, width / 2)
    top = int(np.clip(y - side / 2, 0, height - side))
    left = int(np.clip(x - side / 2, 0, width - side))
    frame.rgba = frame.rgba[top : top + side, left : left + side]
    frame.camera = frame.camera.window(left, top, left + side, top + side)
    return frame


def _on_grey(rgba: np.ndarray) -> np.ndarray:
    """Straight [H, W, 4] in [0, 1] laid over grey, opaque, SIDE pixels a side."""
    alpha = rgba[..., 3:]
    laid = rgba[..., :3] * alpha + _GREY * (1 - alpha)
    laid = resize(np.ascontiguousarray(laid, np.float32), SIDE).clip(0, 1)
    return np.concatenate([laid, np.ones((SIDE, SIDE, 1), np.float32)], 2)
