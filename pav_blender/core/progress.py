"""Progress on standard error: a bar on a terminal, one JSON line a step for other programs."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any, TextIO

# what long work calls: the part done in [0, 1], and whatever else is known by name
Report = Callable[..., None]


class Progress:
    """Called as progress(fraction, **fields); a line at most every `interval` seconds.

    The first and the last call of a task are always shown.
    """

    def __init__(
        self, task: str, *, as_json: bool = False, stream: TextIO | None = None, width: int = 24
    ) -> None:
        self.task = task
        self._json = as_json
        self._stream = stream or sys.stderr
        self._bar = not as_json and self._stream.isatty()
        self._interval = 0.1 if self._bar or as_json else 5.0
        self._width = width
        self._start = time.monotonic()
        self._last = -1e9
        self._first: tuple[float, float] | None = None  # of the first call: time, fraction

    def __call__(self, fraction: float, **fields: Any) -> None:
        now = time.monotonic()
        self._first = self._first or (now, fraction)
        if fraction < 1 and now - self._last < self._interval:
            return
        self._last = now
        seconds = now - self._start
        left = self._left(now, fraction)
        if fraction >= 1:  # what comes after is other work
            self._start, self._first = now, None
        if self._json:
            message = {"task": self.task, "fraction": round(fraction, 5), **fields}
            message["seconds"] = round(seconds, 2)
            message["seconds_left"] = None if left is None else round(left, 2)
            self._write(json.dumps(message) + "\n")
            return
        shown = "  ".join(f"{key} {_short(value)}" for key, value in fields.items())
        ending = "" if left is None else f"  {_clock(left)} left"
        text = f"{self.task} {100 * fraction:5.1f} %  {shown}{ending}"
        if self._bar:
            full = round(self._width * min(fraction, 1))
            text = f"\r[{'#' * full}{'.' * (self._width - full)}] {text}\x1b[K"
            self._write(text + ("\n" if fraction >= 1 else ""))
        else:
            self._write(text + "\n")

    def _left(self, now: float, fraction: float) -> float | None:
        """Seconds, by the pace since the first call: resumed work begins in its middle."""
        began, first = self._first or (now, fraction)
        if first < 0.05:  # from the start: what came before the first call is part of the work
            began, first = self._start, 0.0
        if fraction <= first:
            return 0.0 if fraction >= 1 else None
        return (now - began) * (1 - fraction) / (fraction - first)

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
