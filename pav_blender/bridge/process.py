"""A verb of `pav` as a process of its own, read line by line."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..child import GRACE_S
from ..core.errors import PavError

_KEPT_LINES = 200


@dataclass
class Process:
    """A running `pav VERB ... --json-progress`. `step()` takes in what it said since the last
    call. It stops when its standard input closes, so it ends with Blender, however that ends."""

    arguments: list[str]
    fraction: float = 0.0
    message: str = "Starting"
    error: str = ""
    lines: deque[str] = field(default_factory=lambda: deque(maxlen=_KEPT_LINES))
    _said: queue.SimpleQueue[str] = field(default_factory=queue.SimpleQueue)
    _stopping: bool = False

    def __post_init__(self) -> None:
        try:
            self._child = subprocess.Popen(
                [interpreter(), "-m", "pav_blender.child", *self.arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                env=environment(),
                text=True,
                encoding="utf-8",
                errors="replace",
            )
        except OSError as error:
            raise PavError(f"{interpreter()}: cannot be started ({error.strerror})") from error
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def finished(self) -> bool:
        return self._child.poll() is not None and not self._reader.is_alive()

    def step(self) -> bool:
        """True when the process is over and all it said was read."""
        over = self.finished
        while not self._said.empty():
            self._take(self._said.get())
        if over and not self.error and self._child.returncode != 0:
            self.error = self._last_words()
        return over

    def wait(self) -> None:
        """Blocks for a moment, or until the process ends."""
        try:
            self._child.wait(0.2)
        except subprocess.TimeoutExpired:
            return
        self._reader.join()

    def stop(self) -> None:
        """Asks the process to end; it is killed if it has not after a few seconds."""
        if self._stopping or self._child.poll() is not None:
            return
        self._stopping = True
        self.message = "Stopping"
        assert self._child.stdin is not None
        self._child.stdin.close()
        threading.Thread(target=self._kill_late, daemon=True).start()

    def _kill_late(self) -> None:
        try:
            self._child.wait(2 * GRACE_S)
        except subprocess.TimeoutExpired:
            self._child.kill()

    def _read(self) -> None:
        assert self._child.stderr is not None
        for line in self._child.stderr:
            self._said.put(line.rstrip())

    def _take(self, line: str) -> None:
        if not line:
            return
        try:
            said = json.loads(line)
        except ValueError:
            said = None
        if not isinstance(said, dict):
            self.lines.append(line)
            return
        self.fraction = float(said.get("fraction", self.fraction))
        if not self._stopping:
            self.message = _describe(said)

    def _last_words(self) -> str:
        last = self.lines[-1] if self.lines else "it said nothing"
        if last.startswith("pav: "):  # the one line that says it all
            return last[5:]
        if self._stopping:
            return "Cancelled"
        return f"pav {self.arguments[0]} ended with code {self._child.returncode}: {last}"


def _describe(said: dict[str, Any]) -> str:
    """One progress line of `core.progress` for a panel: "train 40 %, 1:10 left"."""
    text = f"{said.get('task', '')} {100 * float(said.get('fraction', 0)):.0f} %".strip()
    left = said.get("seconds_left")
    if isinstance(left, int | float):
        minutes, seconds = divmod(round(left), 60)
        text += f", {minutes}:{seconds:02d} left"
    return text


def interpreter() -> str:
    """The Python to run: Blender's own, or the one that imported the bpy wheel."""
    return sys.executable


def environment() -> dict[str, str]:
    """Variables under which that Python finds this package, wherever Blender unpacked it, and
    what extensions brought along."""
    parent = Path(__file__).resolve().parents[2]
    brought = [entry for entry in sys.path if "extensions" in Path(entry).parts]
    inherited = os.environ.get("PYTHONPATH", "")
    entries = [str(parent), *brought, *([inherited] if inherited else [])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(entries), "PYTHONUNBUFFERED": "1"}
