"""A folder that somebody else's program wrote: nothing outside of it is read."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ...errors import InputError
from ...reading import MIB
from ...reading import read_arrays as _read_arrays
from ...reading import read_json as _read_json

T = TypeVar("T")
Tell = Callable[[float], None] | None  # of a reader: the part done, from 0 to 1
_LARGEST_JSON = 512 * MIB
PICTURES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG")


class Source:
    """The folder `root`. fence: how far names in its files may lead, itself or its parent.

    Every name is followed through links before it is compared with the fence; one that leads out
    raises InputError, for a file that does this is broken or hostile.
    """

    def __init__(self, root: Path, *, siblings: bool = False) -> None:
        self.root = root.resolve()
        self.fence = self.root.parent if siblings else self.root

    def path(self, name: Any) -> Path:
        """Where a name of one of its files leads; the file need not exist."""
        if not isinstance(name, str) or not name or "\0" in name or not _encodable(name):
            raise InputError(f"{self.root}: {name!r} is not a file's name")
        name = name.replace("\\", "/")
        if name.startswith("/") or re.match(r"[A-Za-z]:", name):
            raise InputError(
                f"{self.root}: the absolute path {name!r} is refused; paths must lie in the folder"
            )
        place = (self.root / name).resolve()
        if not place.is_relative_to(self.fence):
            raise InputError(
                f"{self.root}: {name!r} leads out of {self.fence}; nothing outside is read"
            )
        return place

    def find(self, name: Any, suffixes: tuple[str, ...] = ("",)) -> Path | None:
        """The file of that name, with the first of the suffixes for which there is one."""
        for suffix in suffixes:
            place = self.path(f"{name}{suffix}" if isinstance(name, str) else name)
            if os.path.isfile(place):  # whatever its length
                return place
        return None

    def picture(self, name: Any) -> Path | None:
        """A picture, whether its name has an ending or not."""
        return self.find(name, ("", *PICTURES))

    def json(self, name: str) -> dict[str, Any]:
        return read_json(self.path(name))

    def arrays(self, name: Any) -> dict[str, np.ndarray]:
        """A file of arrays (.npz); InputError where it is missing, damaged or holds objects."""
        return _read_arrays(self.path(name))


def _encodable(name: str) -> bool:
    try:
        os.fsencode(name)
    except UnicodeEncodeError:  # half a surrogate pair, which JSON may hold and no file's name
        return False
    return True


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object; InputError where it is anything else."""
    return _read_json(path, _LARGEST_JSON)


def peek_json(path: Path) -> dict[str, Any]:
    """A JSON object, or an empty one where there is none: for telling formats apart."""
    try:
        inside = path.resolve().parent == path.parent.resolve()
        return read_json(path) if inside and path.is_file() else {}
    except InputError:
        return {}


def exported_head(source: Source) -> str:
    """The fingerprint of the head that `pav export` wrote the source with; "" of other tools'."""
    if not source.find("names.json"):
        return ""
    found = peek_json(source.root / "names.json").get("fingerprint")
    return found if isinstance(found, str) and re.fullmatch(r"[0-9a-f]{64}", found) else ""


def frames_of(content: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(f, dict) for f in frames):
        raise InputError(f"{path}: 'frames' is not a list of frames")
    return frames


def first_frame(content: dict[str, Any]) -> dict[str, Any]:
    """The first frame of a description, {} where there is none."""
    frames = content.get("frames")
    frame = frames[0] if isinstance(frames, list) and frames else {}
    return frame if isinstance(frame, dict) else {}


def numbers(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """`value` as float64 of a shape (-1: any size); InputError names `what`. May be non-finite."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{what}: not numbers") from error
    if len(array.shape) != len(shape) or any(
        want not in (-1, got) for want, got in zip(shape, array.shape, strict=True)
    ):
        raise InputError(f"{what}: shape {list(array.shape)}, {list(shape)} is needed")
    return array


def counted(items: Collection[T], tell: Tell) -> Iterator[T]:
    """The items, one after another; `tell` hears what part is done."""
    for done, item in enumerate(items, 1):
        yield item
        if tell:
            tell(done / len(items))


def number_in(name: str) -> int | None:
    """The last run of digits in a file's name without its ending: its frame number."""
    stem = name.replace("\\", "/").rsplit("/", 1)[-1]
    stem = re.sub(r"\.[A-Za-z]+$", "", stem)
    found = re.findall(r"\d+", stem)
    return int(found[-1]) if found and len(found[-1]) <= 9 else None


def rotation_checked(matrix: np.ndarray, what: str) -> np.ndarray:
    """A 3x3 rotation to within rounding; InputError where it mirrors or scales."""
    if not np.isfinite(matrix).all():
        return matrix  # the frame is left out by name later
    off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if off > 1e-3 or np.linalg.det(matrix) < 0:
        raise InputError(f"{what}: its camera's axes are not a rotation")
    return matrix
