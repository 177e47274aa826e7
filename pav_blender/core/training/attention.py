"""Where training looks: rays go where they teach."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from .frames import Frame


class Attention:
    """How wrong each tile of each frame was when it was last drawn."""

    def __init__(self) -> None:
        self._errors: dict[str, np.ndarray] = {}

    def of(self, frame: Frame) -> np.ndarray:
        """Mean squared errors [K] of a frame's tiles; infinite where none was drawn yet."""
        key = f"{frame.name}@{frame.camera.width}"
        if key not in self._errors:
            self._errors[key] = np.full(len(frame.tiles), np.inf, np.float32)
        return self._errors[key]

    def draw(self, frame: Frame, count: int, random: np.random.Generator) -> np.ndarray:
        """Rows [count] of the frame's tiles, as often as they were wrong; what was never drawn
        counts as much as the worst."""
        errors = self.of(frame)
        known = errors[np.isfinite(errors)]
        worst = known.max() if len(known) and known.max() > 0 else np.float32(1)
        sums = np.cumsum(np.minimum(errors, worst), dtype=np.float64)
        places = (random.random() + np.arange(count)) / count * sums[-1]
        return np.searchsorted(sums, places, side="right").clip(max=len(errors) - 1)

    def note(
        self, frames: Sequence[Frame], starts: Sequence[int], tile: np.ndarray, squared: np.ndarray
    ) -> None:
        """Takes in the squared errors [R] of pixels, those of a frame from its start on; tile [R]
        is each one's row in its frame's tiles, or -1."""
        for frame, a, b in zip(frames, starts, [*starts[1:], len(tile)], strict=True):
            used = tile[a:b] >= 0
            count = np.bincount(tile[a:b][used])
            total = np.bincount(tile[a:b][used], squared[a:b][used])
            drawn = np.flatnonzero(count)
            self.of(frame)[drawn] = total[drawn] / count[drawn]

    def state(self) -> dict[str, torch.Tensor]:
        """What an interrupted training must keep."""
        return {key: torch.from_numpy(errors) for key, errors in self._errors.items()}

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        self._errors = {key: errors.numpy().copy() for key, errors in state.items()}
