"""Avatar files as Blender sees them: resolved paths, names for menus, loaded models kept."""

from __future__ import annotations

import hashlib
import os
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ..core.errors import InputError

_KEPT = 4
_loaded: OrderedDict[tuple[str, int, int], Any] = OrderedDict()
_facts: dict[tuple[str, str], tuple[tuple[str, int, int], Any]] = {}  # by path and what it is


def _identity(path: Path) -> tuple[str, int, int]:
    try:
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path}: no such avatar file") from error
    return str(path), status.st_mtime_ns, status.st_size


def heads_of(objects: Iterable[Any]) -> list[Any]:
    """The mesh objects among `objects` that wear an avatar."""
    return [thing for thing in objects if thing.type == "MESH" and thing.pav.avatar]


def resolve(stored: str, library: Any | None = None) -> Path:
    """The file that a stored path ("//" starts at the .blend, or at the linked library) names."""
    import bpy

    if stored.startswith("//") and not (library.filepath if library else bpy.data.filepath):
        raise InputError(
            f"avatar file {stored!r} is relative to the .blend, which was never saved; save it "
            "or choose the avatar again"
        )
    return Path(bpy.path.abspath(stored, library=library))


def path_of(pav: Any) -> Path:
    """The avatar file of an object's `pav` properties: the packed one, where there is one, else the
    one that its path names. InputError where the path cannot be resolved."""
    from .packing import unpacked

    if pav.pack.text is not None:
        return unpacked(pav.pack.text)
    return resolve(pav.avatar, _library(pav))


def own_path(pav: Any) -> bool:
    """Whether an object's path is its own, not that of the library that it overrides."""
    return _library(pav) is None


def _library(pav: Any) -> Any | None:
    """The library whose folder an object's path starts at: a library override keeps the path of
    the object that it overrides until another is chosen."""
    object_ = pav.id_data.original
    override = object_.override_library
    if override is None or override.reference is None:
        return object_.library
    reference = override.reference
    return reference.library if reference.pav.avatar == pav.avatar else None


def chosen_number(pav: Any) -> int:
    """The number of the appearance chosen for an object, also where its file is missing; 0: none
    was chosen."""
    if not pav.is_property_set("appearance"):
        return 0
    # from Blender 5 on what bpy.props stores is no longer among the custom properties
    stored = pav.bl_system_properties_get() if hasattr(pav, "bl_system_properties_get") else pav
    return int(stored.get("appearance", 0))


def stored_path(path: Path, blend: str) -> str:
    """`path` relative to a saved .blend ("//..."), so that both can move together; else absolute.

    Also absolute where no relative path exists (another drive on Windows).
    """
    path = path.resolve()
    if not blend:
        return str(path)
    try:
        relative = os.path.relpath(path, Path(blend).resolve().parent)
    except ValueError:
        return str(path)
    return "//" + relative.replace(os.sep, "/")


def load(path: Path) -> Any:
    """The `Avatar` in a file; read again only when the file changed. InputError, one line."""
    from ..core.field.avatar import Avatar

    key = _identity(path)
    if key not in _loaded:
        _loaded[key] = Avatar.load(path)
        while len(_loaded) > _KEPT:
            _loaded.popitem(last=False)
    _loaded.move_to_end(key)
    return _loaded[key]


def header(path: Path) -> dict[str, Any]:
    """The header of an avatar file, cached. InputError, one line."""
    from ..core.field.avatar import read_header

    return _known("header", path, read_header)


def looks(path: Path, person: str) -> list[str]:
    """The appearances of an avatar file; where it is of several people and `person` is one of
    them, that one's alone. InputError, one line."""
    known = header(path)
    return list(known.get("identities", {}).get(person, known["appearances"]))


def content(path: Path) -> str:
    """A hash of an avatar file, the same wherever it lies; read again only when it changed.
    InputError, one line."""
    return _known("content", path, _hash)


def _hash(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def _known(what: str, path: Path, read: Callable[[Path], Any]) -> Any:
    """What `read` says of a file, asked again only when the file changed."""
    identity = _identity(path)
    known = _facts.get((what, str(path)))
    if known is None or known[0] != identity:
        _facts[what, str(path)] = known = (identity, read(path))
    return known[1]


def forget() -> None:
    """Drops every loaded model."""
    _loaded.clear()
    _facts.clear()


def number(name: str) -> int:
    """The number of an appearance in menus and keyframes: the same for a name in every avatar.

    Below 2^24, so that a keyframe (float32) holds it exactly; never 0, which is "not chosen".
    """
    return (zlib.crc32(name.encode()) & 0xFFFFFF) or 1
