"""A verb of `pav` (or pip) as a process of its own, read line by line."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..child import GRACE_S, PACKAGES
from ..core.errors import PavError
from . import packages

_KEPT_LINES = 200

Fields = dict[str, Any]


def json_fields(line: str) -> Fields | None:
    """What a line of `core.progress` says, or None where it is none."""
    try:
        said = json.loads(line)
    except ValueError:
        return None
    return said if isinstance(said, dict) else None


@dataclass
class Process:
    """A running `pav VERB ... --json-progress`. `step()` takes in what it said since the last
    call, and tells `listen`. It stops when its standard input closes, so it ends with Blender,
    however that ends. merged: what it prints is read too; understand: line -> fields, or None;
    measure: tells the part done of work that says nothing of it."""

    arguments: list[str]
    listen: Callable[[Fields], None] | None = None
    merged: bool = False
    understand: Callable[[str], Fields | None] = json_fields
    measure: Callable[[], float] | None = None
    python: str | None = None  # the chosen one, if None
    variables: dict[str, str] = field(default_factory=dict)  # of its environment, besides
    fraction: float = 0.0
    message: str = "Starting"
    error: str = ""
    lines: deque[str] = field(default_factory=lambda: deque(maxlen=_KEPT_LINES))
    _said: queue.SimpleQueue[str] = field(default_factory=queue.SimpleQueue)
    _stopping: bool = False

    def __post_init__(self) -> None:
        python = self.python or interpreter()
        try:
            self._child = subprocess.Popen(
                [python, "-P", "-m", "pav_blender.child", *self.arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE if self.merged else subprocess.DEVNULL,
                stderr=subprocess.STDOUT if self.merged else subprocess.PIPE,
                env=environment(python) | self.variables,
                text=True,
                encoding="utf-8",
                errors="replace",
            )
        except OSError as error:
            raise PavError(f"{python}: cannot be started ({error.strerror})") from error
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
        if self.measure is not None and not over:
            self.fraction = max(self.fraction, self.measure())
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
        """Asks the process to end; it is killed if it has not after a while."""
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
        stream = self._child.stdout if self.merged else self._child.stderr
        assert stream is not None
        for line in stream:
            self._said.put(line.rstrip())

    def _take(self, line: str) -> None:
        if not line:
            return
        said = self.understand(line)
        if said is None:
            self.lines.append(line)
            return
        self.fraction = float(said.get("fraction", self.fraction))
        if not self._stopping:
            self.message = str(said.get("message") or _describe(said))
        if self.listen is not None:
            self.listen(said)

    def _last_words(self) -> str:
        last = self.lines[-1] if self.lines else "it said nothing"
        if last.startswith("pav: "):  # the one line that says it all
            return last[5:]
        if self._stopping:
            return "Cancelled"
        verb = self.arguments[0]
        what = verb if verb == "pip" else f"pav {verb}"
        wrong = [line for line in self.lines if line.startswith("ERROR: ")]  # pip adds advice
        last = wrong[-1][7:] if wrong else last
        return f"{what} ended with code {self._child.returncode}: {last}"


def _describe(said: Fields) -> str:
    """One progress line of `core.progress` for a panel: "train 40 %, 1:10 left"."""
    text = f"{said.get('task', '')} {100 * float(said.get('fraction', 0)):.0f} %".strip()
    left = said.get("seconds_left")
    if isinstance(left, int | float):
        minutes, seconds = divmod(round(left), 60)
        text += f", {minutes}:{seconds:02d} left"
    return text


def interpreter() -> str:
    """The Python to run: the one chosen in the preferences, else Blender's own, or the one that
    imported the bpy wheel."""
    return packages.chosen_python() or sys.executable


def environment(python: str) -> dict[str, str]:
    """Variables under which a Python finds this package, wherever Blender unpacked it, and, if it
    is Blender's, what extensions brought along and the folders that were added."""
    entries = [str(Path(__file__).resolve().parents[2])]
    variables = {**os.environ, "PYTHONUNBUFFERED": "1"}
    if python == sys.executable:
        added = packages.added()
        brought = (entry for entry in sys.path if "extensions" in Path(entry).parts)
        entries += [entry for entry in brought if entry not in added]
        variables[PACKAGES] = os.pathsep.join(added)
    inherited = os.environ.get("PYTHONPATH", "")
    variables["PYTHONPATH"] = os.pathsep.join([*entries, *([inherited] if inherited else [])])
    return variables
