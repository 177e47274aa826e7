"""Pictures whose inputs did not change are not drawn again: in this process, and on disk."""

from __future__ import annotations

import dataclasses
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..core.version import version
from . import avatars, render
from .render import Pixels
from .shot import Shot

LIMIT = 512 << 20  # bytes of pictures kept: six frames at 1920x1080

# says nothing about the picture, as every other field of a shot and its actors does
_SILENT = {"name", "chunk"}

_kept: OrderedDict[str, Pixels] = OrderedDict()
_lock = threading.Lock()


def digest(shot: Shot, *more: str) -> str:
    """A name for everything that a shot's picture depends on, the same on every machine: avatars
    count by their files' content. `more`: what else a file of it depends on. InputError where an
    avatar file is missing."""
    state = hashlib.sha256()
    for part in (version(), *more):
        _add(state, part)
    _add(state, shot)
    return state.hexdigest()


def draw(
    shot: Shot,
    progress: Callable[[float], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Pixels:
    """As `render.draw`, without drawing what was drawn lately; the arrays are read-only."""
    name = digest(shot)
    with _lock:
        if name in _kept:
            _kept.move_to_end(name)
            return _kept[name]
    pixels = render.draw(shot, progress, should_stop)
    for array in _arrays(pixels):
        array.flags.writeable = False
    with _lock:
        _kept[name] = pixels
        while sum(map(_size, _kept.values())) > LIMIT:
            _kept.popitem(last=False)
    return pixels


def forget() -> None:
    """Drops every kept picture."""
    with _lock:
        _kept.clear()


def _arrays(pixels: Pixels) -> tuple[np.ndarray, ...]:
    return pixels.combined, pixels.depth, pixels.display


def _size(pixels: Pixels) -> int:
    return sum(array.nbytes for array in _arrays(pixels))


def _add(state: Any, value: Any) -> None:
    """Feeds a value into a hash so that no two different ones look alike."""
    if isinstance(value, np.ndarray):
        state.update(f"array {value.dtype.str} {value.shape};".encode())
        state.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Path):  # only avatars' files have paths in a shot
        state.update(f"file {avatars.content(value)};".encode())
    elif dataclasses.is_dataclass(value):
        state.update(f"{type(value).__name__};".encode())
        for item in dataclasses.fields(value):
            if item.name not in _SILENT:
                state.update(f"{item.name}=".encode())
                _add(state, getattr(value, item.name))
    elif isinstance(value, dict):
        state.update(f"dict {len(value)};".encode())
        for key in sorted(value):
            _add(state, key)
            _add(state, value[key])
    elif isinstance(value, tuple | list):
        state.update(f"list {len(value)};".encode())
        for part in value:
            _add(state, part)
    else:
        text = repr(value)
        state.update(f"{len(text)} {text};".encode())
