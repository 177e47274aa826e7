"""Ending long work politely."""

from __future__ import annotations

import signal
from types import FrameType


class StopSignal:
    """True after Ctrl-C or a polite kill, so that work ends where it can be taken up again."""

    def __init__(self) -> None:
        self._stopped = False
        for kind in (signal.SIGINT, signal.SIGTERM):
            signal.signal(kind, self._stop)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self._stopped = True

    def __call__(self) -> bool:
        return self._stopped
