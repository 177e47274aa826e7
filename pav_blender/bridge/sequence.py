"""Rendering a scene's frames straight to PNG files, drawing on a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import Cancelled, InputError, PavError
from ..core.rendering.colour import linear_to_srgb
from . import requirements, turns
from .render import Pixels, draw
from .shot import Shot, read_shot


@dataclass
class Sequence:
    """Frames `first` to `last` of a scene into `folder`, as `frame_path` names them.

    Frames whose file is already whole are kept, so a broken run goes on where it stopped; empty or
    unreadable files count as missing. `step()` is called on the main thread until it returns
    True; `stop()` ends the work after the current frame is dropped.
    """

    scene: str
    folder: Path
    first: int
    last: int
    done: int = 0
    kept: int = 0
    error: str = ""
    stopping: threading.Event = field(default_factory=threading.Event)
    _frame: int | None = None
    _thread: threading.Thread | None = None

    @property
    def total(self) -> int:
        return self.last - self.first + 1

    @property
    def fraction(self) -> float:
        return self.done / max(1, self.total)

    @property
    def message(self) -> str:
        return self.error or f"Frame {min(self.first + self.done, self.last)} of {self.last}"

    @property
    def finished(self) -> bool:
        return self.done >= self.total or bool(self.error) or self.stopping.is_set()

    def step(self) -> bool:
        """Starts the next frame if none is being drawn; True when all is done or it failed."""
        if self._thread is not None:
            if self._thread.is_alive():
                return False
            self._thread = None
        while not self.finished:
            frame = self.first + self.done
            if is_whole(frame_path(self.folder, frame)):
                self.done += 1
                self.kept += 1
                continue
            self._start(frame)
            return False
        return True

    def wait(self) -> None:
        """Blocks until the frame in work is done."""
        if self._thread is not None:
            self._thread.join()

    def stop(self) -> None:
        self.stopping.set()

    def _start(self, frame: int) -> None:
        try:
            shot = read_frame(self.scene, frame)
        except Exception as error:
            self.error = _line(error, frame)
            return
        path = frame_path(self.folder, frame)
        self._thread = threading.Thread(target=self._draw, args=(shot, path, frame), daemon=True)
        self._thread.start()

    def _draw(self, shot: Shot, path: Path, frame: int) -> None:
        from ..core import images

        try:
            with turns.first():
                pixels = draw(shot, should_stop=self.stopping.is_set)
            images.write_rgba(path, display(shot, pixels), metadata={"Software": "pav_blender"})
            self.done += 1
        except Cancelled:
            self.stopping.set()
        except Exception as error:
            self.error = _line(error, frame)


def begin(scene: Any, folder: Path) -> Sequence:
    """A sequence of the scene's frame range; makes the folder. PavError where it cannot work."""
    requirements.check()
    if scene.frame_end < scene.frame_start:
        raise InputError(f"scene {scene.name!r}: its frame range is empty")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot make this folder ({error.strerror})") from error
    return Sequence(scene.name, folder, scene.frame_start, scene.frame_end)


def frame_path(folder: Path, frame: int) -> Path:
    return folder / f"{frame:06d}.png"


def is_whole(path: Path) -> bool:
    """True for a picture that can be read to its end."""
    from ..core import images

    if not path.is_file() or path.stat().st_size == 0:
        return False
    try:
        images.read_rgba(path)
    except PavError:
        return False
    return True


def read_frame(scene_name: str, frame: int) -> Shot:
    """The shot of one frame of a scene, with render visibility and modifiers as in the viewport's
    evaluated scene. Leaves the scene at that frame."""
    import bpy

    scene = bpy.data.scenes[scene_name]
    scene.frame_set(frame)
    layer = scene.view_layers[0]
    layer.update()
    return read_shot(None, layer.depsgraph)


def display(shot: Shot, pixels: Pixels) -> np.ndarray:
    """Straight sRGB [H, W, 4] for a file: the drawn picture, or that over the background."""
    if shot.background is None:
        return pixels.display
    encoded = linear_to_srgb(pixels.combined[..., :3])
    return np.concatenate([encoded, pixels.combined[..., 3:]], axis=2).astype(np.float32)


def _line(error: Exception, frame: int) -> str:
    name = "" if isinstance(error, PavError) else f"{type(error).__name__}: "
    return f"frame {frame}: {name}{error}"


def blocking(sequence: Sequence, report: Callable[[str], None]) -> None:
    """Runs a sequence to its end."""
    while not sequence.step():
        sequence.wait()
        report(sequence.message)
