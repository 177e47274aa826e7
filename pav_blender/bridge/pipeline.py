"""Several processes, one after another, as one job."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from ..core.errors import PavError
from .process import Process


@dataclass
class Phase:
    """A part of a job: its name, about how long it takes beside the others, and what starts it."""

    label: str
    weight: float
    start: Callable[[], Process]
    fraction: float = 0.0


@dataclass
class Pipeline:
    """Runs phases in order (`Work` of `jobs`). finish: called when all went well; its PavError is
    the job's. abandon: called when they did not."""

    phases: Sequence[Phase]
    finish: Callable[[], None] | None = None
    abandon: Callable[[], None] | None = None
    error: str = ""
    index: int = 0
    _current: Process = field(init=False)
    _over: bool = False
    _stopped: bool = False

    def __post_init__(self) -> None:
        self._current = self.phases[0].start()

    @property
    def fraction(self) -> float:
        total = sum(phase.weight for phase in self.phases)
        return sum(phase.weight * phase.fraction for phase in self.phases) / total

    @property
    def message(self) -> str:
        number = f"{self.index + 1}/{len(self.phases)} " if len(self.phases) > 1 else ""
        return f"{number}{self._current.message}"

    def step(self) -> bool:
        if self._over:
            return True
        over = self._current.step()
        phase = self.phases[self.index]
        phase.fraction = self._current.fraction
        if not over:
            return False
        if self._current.error:
            return self._end(self._current.error)
        phase.fraction = 1.0
        if self.index + 1 == len(self.phases):
            return self._end("")
        if self._stopped:
            return self._end("Cancelled")
        self.index += 1
        try:
            self._current = self.phases[self.index].start()
        except PavError as error:
            return self._end(str(error))
        return False

    def wait(self) -> None:
        self._current.wait()

    def stop(self) -> None:
        self._stopped = True
        self._current.stop()

    def _end(self, error: str) -> bool:
        self._over, self.error = True, error
        then = self.abandon if error else self.finish
        if then is not None:
            try:
                then()
            except PavError as problem:
                self.error = error or str(problem)
        return True
