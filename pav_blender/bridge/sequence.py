"""Rendering a scene's frames straight to picture files, drawing on a thread of its own."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core import images
from ..core.errors import Cancelled, InputError, PavError
from ..core.frame_files import damage
from ..core.rendering.colour import linear_to_srgb
from ..core.rendering.frames import FORMATS, Format, provenance, write_frame
from . import requirements, turns
from .render import Pixels
from .reuse import digest, draw
from .shot import Shot, find_actors, read_shot

_PATIENCE_S = 0.1  # a step that only looks at files lets the window live after so long


@dataclass
class Sequence:
    """Frames `first` to `last` of a scene into `folder`, as `frame_path` names them; once for each
    name in `appearances`, in a folder of that name, or as the scene has it where there are none.

    A frame whose file is whole and was drawn from the same inputs is kept, so a broken run goes on
    where it stopped; every other one is drawn (again). `step()` is called on the main thread until
    it returns True; `stop()` ends the work after the current frame is dropped.
    """

    scene: str
    folder: Path
    first: int
    last: int
    format: Format
    appearances: tuple[str, ...] = ()
    done: int = 0
    kept: int = 0
    error: str = ""
    stopping: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    @property
    def total(self) -> int:
        return (self.last - self.first + 1) * max(1, len(self.appearances))

    @property
    def fraction(self) -> float:
        return self.done / max(1, self.total)

    @property
    def message(self) -> str:
        frame, name = self._at(min(self.done, self.total - 1))
        return self.error or f"Frame {frame} of {self.last}{f', {name}' if name else ''}"

    @property
    def finished(self) -> bool:
        return self.done >= self.total or bool(self.error) or self.stopping.is_set()

    def step(self) -> bool:
        """Starts the next frame if none is being drawn; True when all is done or it failed."""
        if self._thread is not None:
            if self._thread.is_alive():
                return False
            self._thread = None
        started = time.monotonic()
        while not self.finished and self._thread is None:
            self._begin(*self._at(self.done))
            if time.monotonic() - started > _PATIENCE_S:
                break
        return self.finished and self._thread is None

    def wait(self) -> None:
        """Blocks until the frame in work is done."""
        if self._thread is not None:
            self._thread.join()

    def stop(self) -> None:
        self.stopping.set()

    def _at(self, index: int) -> tuple[int, str | None]:
        """Frame number and appearance of a picture: all appearances of a frame, then the next."""
        count = max(1, len(self.appearances))
        name = self.appearances[index % count] if self.appearances else None
        return self.first + index // count, name

    def _begin(self, frame: int, appearance: str | None) -> None:
        """Keeps the file of a picture, or starts drawing it."""
        try:
            shot = wearing(read_frame(self.scene, frame), appearance)
            folder = self.folder / appearance if appearance else self.folder
            path = frame_path(folder, frame, self.format.suffix)
            inputs = digest(shot, self.format.name)
            if is_kept(path, inputs):
                self.done += 1
                self.kept += 1
                return
            files = [actor.avatar.name for actor in shot.actors]
            settings = f"{shot.quality}, {self.format.name}"
            told = provenance(files, [worn_names(actor) for actor in shot.actors], frame, settings)
        except Exception as error:
            self.error = _line(error, frame)
            return
        told["pav:inputs"] = inputs
        self._thread = threading.Thread(
            target=self._draw, args=(shot, path, frame, told), daemon=True
        )
        self._thread.start()

    def _draw(self, shot: Shot, path: Path, frame: int, told: dict[str, str]) -> None:
        try:
            with turns.first():
                pixels = draw(shot, should_stop=self.stopping.is_set)
            straight = display(shot, pixels)
            write_frame(path, self.format, straight, pixels.combined, pixels.depth, told)
            self.done += 1
        except Cancelled:
            self.stopping.set()
        except Exception as error:
            self.error = _line(error, frame)


def begin(scene: Any, folder: Path) -> Sequence:
    """A sequence of the scene's frame range, as its settings say; makes the folder. PavError where
    it cannot work."""
    requirements.check()
    if scene.frame_end < scene.frame_start:
        raise InputError(f"scene {scene.name!r}: its frame range is empty")
    settings = scene.pav.frames
    names = every_appearance(scene) if settings.appearances == "ALL" else ()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot make this folder ({error.strerror})") from error
    format = FORMATS[settings.format.lower()]
    return Sequence(scene.name, folder, scene.frame_start, scene.frame_end, format, names)


def every_appearance(scene: Any) -> tuple[str, ...]:
    """The appearances that all heads of a scene have. InputError where there is none."""
    layer = scene.view_layers[0]
    layer.update()
    actors = find_actors(layer.depsgraph)
    known = [actor.looks for actor in actors]
    shared = tuple(n for n in known[0] if all(n in names for names in known)) if known else ()
    if not shared:
        raise InputError(
            f"scene {scene.name!r}: its heads have no appearance in common; write the frames as "
            "in the scene"
        )
    for name in shared:
        parts = name.split("/")  # "person/look" is a folder in a folder
        if set('\\:*?"<>|\0') & set(name) or not all(p and p[0] != "." for p in parts):
            raise InputError(f"appearance {name!r} cannot name a folder; write it by itself")
    return shared


def wearing(shot: Shot, appearance: str | None) -> Shot:
    """The shot with every head in an appearance alone, without layers; as it is for None."""
    if appearance is None:
        return shot
    actors = (replace(actor, appearance=appearance, layers=()) for actor in shot.actors)
    return replace(shot, actors=tuple(actors))


def worn_names(actor: Any) -> str:
    """What an actor wears, in words: its appearance, and layers with their weights."""
    base = str(actor.appearance or actor.looks[0])
    return " + ".join([base, *(f"{layer.appearance} {layer.weight:g}" for layer in actor.layers)])


def frame_path(folder: Path, frame: int, suffix: str = ".png") -> Path:
    return folder / f"{frame:06d}{suffix}"


def is_kept(path: Path, inputs: str) -> bool:
    """True for a picture that can be read to its end and was drawn from these inputs."""
    if not path.is_file() or damage(path):
        return False
    return images.read_metadata(path).get("pav:inputs") == inputs


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
