"""Folders of numbered frames: which are whole, which are damaged, which numbers are missing.

A renderer that is killed may leave half a picture, or an empty placeholder, under a frame's final
name; a resumed one takes both for done.
"""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass, field
from pathlib import Path

from . import images
from .errors import InputError

# every picture format here is known to be read to its end by OpenImageIO, so that a file which is
# not is a damaged one
SUFFIXES = {".png", ".exr", ".jpg", ".jpeg", ".tif", ".tiff", ".tga", ".bmp", ".hdr", ".webp"}
_NUMBERED = re.compile(r"(?P<stem>.*?)(?P<number>\d+)(?P<suffix>\.[A-Za-z]+)")
# as `files.replacing` and the rendering of a .blend name what they have not finished
_LEFT_FILE = re.compile(r"\..+\.partial-\w+(?P<suffix>\.\w+)")
_LONGEST = 1_000_000  # frames of a range
_LEFT_FOLDER = re.compile(r"\.partial-\w+")


@dataclass
class FrameFiles:
    """A folder's frames: paths by their state, and numbers within the range that have no picture
    or a damaged one. `left`: what killed processes left under temporary names."""

    folder: Path
    whole: list[Path] = field(default_factory=list)
    damaged: dict[Path, str] = field(default_factory=dict)
    missing: list[int] = field(default_factory=list)
    left: list[Path] = field(default_factory=list)


def look(folder: Path, span: tuple[int, int] | None = None) -> FrameFiles:
    """Reads every numbered picture in a folder to its end.

    span: the first and last number that should be there; None: of the lowest to the highest found.
    InputError where there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    found = FrameFiles(folder)
    numbers, good = set(), set()
    for path in sorted(folder.iterdir()):
        if _is_left(path):
            found.left.append(path)
            continue
        match = _NUMBERED.fullmatch(path.name)
        if match is None or match["suffix"].lower() not in SUFFIXES or not path.is_file():
            continue
        number = int(match["number"])
        numbers.add(number)
        problem = damage(path)
        if problem:
            found.damaged[path] = problem
        else:
            found.whole.append(path)
            good.add(number)
    if span is None and numbers:
        span = min(numbers), max(numbers)
    if span is not None and span[1] - span[0] >= _LONGEST:
        raise InputError(
            f"{folder}: pictures numbered from {span[0]} to {span[1]}; at most {_LONGEST} are "
            "looked for: say with --range which ones should be there"
        )
    if span is not None:
        found.missing = [n for n in range(span[0], span[1] + 1) if n not in good]
    return found


def _is_left(path: Path) -> bool:
    if path.is_dir():
        return _LEFT_FOLDER.fullmatch(path.name) is not None
    match = _LEFT_FILE.fullmatch(path.name)
    return match is not None and match["suffix"].lower() in SUFFIXES


def damage(path: Path) -> str:
    """Why a picture cannot be read to its end, in a few words; "" for a whole one."""
    if path.stat().st_size == 0:
        return "empty"
    try:
        images.check(path)
    except InputError as error:
        return str(error).removeprefix(f"{path}: ")
    return ""


def clear(found: FrameFiles) -> None:
    """Removes the damaged frames and what was left under temporary names, so that a resumed render
    draws them again. Nothing else may be writing there. InputError where a file cannot go."""
    for path in (*found.damaged, *found.left):
        try:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise InputError(f"{path}: cannot be removed ({error.strerror})") from error


def ranges(numbers: list[int]) -> str:
    """Rising numbers as "1-3, 7"."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)
