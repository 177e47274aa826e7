"""The one job that runs beside Blender's window, kept here because operators die when another
file is opened.

A job has `step() -> bool` (True when over), `wait()`, `stop()`, `fraction`, `message`, `error`.
"""

from __future__ import annotations

import atexit
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import bpy

from ..core.errors import PavError
from .windows import redraw

TRAINING, WRITING = "Training", "Writing frames"
INSTALLING, CHECKING = "Installing", "Checking"
_INTERVAL_S = 0.2


class Work(Protocol):
    error: str

    @property
    def fraction(self) -> float: ...
    @property
    def message(self) -> str: ...
    def step(self) -> bool: ...
    def wait(self) -> None: ...
    def stop(self) -> None: ...


@dataclass
class Job:
    """`work` under the name that the panel shows; `result` is what to say when it went well."""

    name: str
    work: Work
    result: str
    running: bool = True

    @property
    def status(self) -> str:
        if self.running:
            return self.work.message
        return self.work.error or self.result


_jobs: list[Job] = []


def current() -> Job | None:
    """The running job, or the last one that ran."""
    return _jobs[-1] if _jobs else None


def running() -> bool:
    job = current()
    return job is not None and job.running


def start(name: str, make: Callable[[], Work], result: str) -> Job:
    """Starts a job: beside the window, or to its end where there is none (timers would never
    fire). PavError where one runs already, or (without a window) where it failed."""
    if running():
        raise PavError("another job is running; wait for it or cancel it")
    job = Job(name, make(), result)
    _jobs[:] = [job]
    if bpy.app.background:
        _run_blocking(job)
    else:
        bpy.app.timers.register(_tick, first_interval=_INTERVAL_S, persistent=True)
    return job


def cancel() -> None:
    job = current()
    if job is not None and job.running:
        job.work.stop()


def _run_blocking(job: Job) -> None:
    said = ""
    while not job.work.step():
        job.work.wait()
        if job.work.message != said:
            said = job.work.message
            print(f"{job.name}: {said}", file=sys.stderr, flush=True)
    job.running = False
    if job.work.error:
        raise PavError(job.work.error)


def _tick() -> float | None:
    job = current()
    if job is None:
        return None
    if job.running and job.work.step():
        job.running = False
        redraw("PREFERENCES", "PROPERTIES", "VIEW_3D")
        return None
    redraw("PREFERENCES", "PROPERTIES", "VIEW_3D")
    return _INTERVAL_S


def register() -> None:
    atexit.register(cancel)


def unregister() -> None:
    cancel()
    atexit.unregister(cancel)
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
