"""Watches a training's loss: which batches to learn from, and whether it has gone astray."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

_KEEP = 0.98  # of the mean, a batch
_FIRST = 50  # batches that are taken as they come: before that no mean says anything
_TIMES = 10.0  # a batch's loss over the mean from which it is a spike
_IN_A_ROW = 20  # spikes after which it is not the batches


@dataclass
class Watch:
    """floor: a loss that is never a spike.

    mean: of the losses of batches that were learned from; lowest: the least it ever was; skipped:
    batches that were not learned from, `row` of them since the last that was. What is watched is a
    number a batch that is there anyway: nothing is computed for it.
    """

    floor: float
    taken: int = 0
    mean: float = 0.0
    lowest: float = math.inf
    skipped: int = 0
    row: int = 0

    def takes(self, loss: float) -> bool:
        """Whether to learn from a batch of this loss: it is finite, and no spike."""
        if not math.isfinite(loss) or (self.taken >= _FIRST and loss > self._limit(self.mean)):
            self.skipped += 1
            self.row += 1
            return False
        self.row = 0
        keep = _KEEP if self.taken >= _FIRST else self.taken / (self.taken + 1)
        self.mean = keep * self.mean + (1 - keep) * loss
        self.taken += 1
        if self.taken >= _FIRST:
            self.lowest = min(self.lowest, self.mean)
        return True

    @property
    def astray(self) -> bool:
        """Whether one spike follows another, or the mean has risen far above what it was."""
        return self.row >= _IN_A_ROW or self.mean > self._limit(self.lowest)

    def begin_anew(self) -> None:
        """Forgets which losses are usual: after going back, or where the data is another."""
        self.taken, self.mean, self.lowest, self.row = 0, 0.0, math.inf, 0

    def _limit(self, usual: float) -> float:
        return _TIMES * usual + self.floor

    def state(self) -> dict[str, float]:
        """What an interrupted training must keep, as JSON takes it."""
        values = dataclasses.asdict(self)
        return {k: v for k, v in values.items() if math.isfinite(v)}

    def restore(self, state: dict[str, float]) -> None:
        for name, value in state.items():
            setattr(self, name, value)
