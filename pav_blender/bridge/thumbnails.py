"""Small pictures of an avatar's appearances for menus, which the avatar draws when first asked."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.errors import InputError, PavError
from . import avatars, requirements, turns
from .windows import redraw, show_as_icon

SIZE = 96  # pixels a side
_POLL_S = 0.3
_WIDE, _AWAY = 0.34, 1.2  # metres: what a picture shows, and from where

_previews: Any = None
_asked: set[tuple[Path, int]] = set()  # files as they were when asked for
_wanted: list[tuple[Path, str]] = []  # for the thread, which keeps what it draws here until done
_drawn: list[tuple[Path, str, np.ndarray]] = []  # by the thread, until the timer takes them
_thread: threading.Thread | None = None


def icons(path: Path, names: Sequence[str]) -> list[int]:
    """The icon of each appearance of an avatar file; 0 while there is none yet. Pictures are drawn
    beside everything else; none are without a window."""
    nothing = [0] * len(names)
    ours = threading.current_thread() is threading.main_thread()  # a render asks from its own
    if bpy.app.background or not ours:
        return nothing
    try:
        identity = path, path.stat().st_mtime_ns
    except OSError:
        return nothing
    if identity not in _asked and not requirements.missing():
        _asked.add(identity)
        _ask(path, names)
    if _previews is None:
        return nothing
    keys = [_key(path, name) for name in names]
    return [_previews[key].icon_id if key in _previews else 0 for key in keys]


def draw(path: Path, name: str) -> np.ndarray:
    """An appearance from the front, at rest: straight sRGB [SIZE, SIZE, 4] float32, row 0 on top.
    PavError where the file cannot be read."""
    from ..core.field.avatar import head_of
    from ..core.field.identities import identity
    from ..core.rendering.cameras import Camera
    from ..core.rendering.render import RenderSettings, render

    avatar = avatars.load(path)
    try:
        points = head_of(avatar, name).shaped(identity(avatar, name).betas)
    except InputError:  # the head model is not at hand: as it was learned, the mouth open
        points = avatar.canonical_vertices
    weights = avatar.rigid_weights
    middle = (points * weights[:, None]).sum(0) / max(float(weights.sum()), 1e-9)
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])  # looking along -z, y down in the picture
    pose[:3, 3] = [middle[0], middle[1], middle[2] + _AWAY]
    focal = SIZE * _AWAY / _WIDE
    intrinsics = np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]])
    camera = Camera(SIZE, SIZE, intrinsics, pose)
    settings = RenderSettings.preset("preview")
    return np.asarray(render(avatar, points, camera, name, settings).rgba, np.float32)


def forget() -> None:
    """Drops all pictures."""
    global _previews
    if bpy.app.timers.is_registered(_take):
        bpy.app.timers.unregister(_take)
    if _previews is not None:
        bpy.utils.previews.remove(_previews)
        _previews = None
    for kept in (_asked, _wanted, _drawn):
        kept.clear()


def _ask(path: Path, names: Sequence[str]) -> None:
    global _thread
    _wanted.extend((path, name) for name in names)
    if _thread is None or not _thread.is_alive():
        _thread = threading.Thread(target=_work, daemon=True)
        _thread.start()
    if not bpy.app.timers.is_registered(_take):
        bpy.app.timers.register(_take, first_interval=_POLL_S, persistent=True)


def _work() -> None:
    while _wanted:
        path, name = _wanted[0]
        with turns.changed:  # what the user waits for goes first
            turns.changed.wait_for(lambda: not turns.wanted())
        try:
            picture = draw(path, name)
        except PavError:
            picture = None  # the panel and the renderer say what is wrong with the file
        if _wanted and _wanted[0] == (path, name):  # not forgotten meanwhile
            if picture is not None:
                _drawn.append((path, name, picture))
            _wanted.pop(0)


def _take() -> float | None:
    """On the main thread: drawn pictures become icons."""
    global _previews
    if _previews is None:
        from bpy.utils import previews

        _previews = previews.new()
    over = not _wanted  # asked before the drawn ones are taken: none is left behind
    fresh = bool(_drawn)
    while _drawn:
        path, name, picture = _drawn.pop(0)
        key = _key(path, name)
        preview = _previews[key] if key in _previews else _previews.new(key)
        show_as_icon(preview, picture)
    if fresh:
        redraw("VIEW_3D")
    return None if over else _POLL_S


def _key(path: Path, name: str) -> str:
    return f"{path}\n{name}"
