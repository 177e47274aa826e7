"""Finding a head model: by name, by file, or by the fingerprint of one used before.

Avatars and collections name a head and its fingerprint, never hold one. Where its files lie on
this machine is remembered in the user's preferences.
"""

from __future__ import annotations

import os
from dataclasses import fields
from functools import lru_cache
from pathlib import Path

from .. import preferences
from ..errors import InputError
from .builtin import BUILTIN, builtin_head
from .files import read_head
from .flame import FlameFiles, find_flame, looks_like_flame, read_flame
from .model import HeadModel

_SECTION = "heads"


def load_head(
    name_or_path: str | Path,
    fingerprint: str = "",
    *,
    flame_version: str = "",
    beside: Path | None = None,
) -> HeadModel:
    """The head called "builtin", one remembered by `fingerprint`, or the one in a file.

    A file is a head file of ours, or FLAME's (.pkl, a converted .npz, or a folder that holds one),
    named from the folder `beside` (None: from the working folder); flame_version says which FLAME
    where its name does not. Raises InputError where the head is not found, or the one found has
    another fingerprint.
    """
    place = Path(name_or_path)  # `os.path` bears a name that is too long for a file, `Path` not
    if beside is not None and os.path.exists(beside / place):
        place = beside / place
    known = preferences.read(_SECTION)
    own = str(name_or_path) == BUILTIN
    if own and (fingerprint not in known or fingerprint == builtin_head().fingerprint):
        head = builtin_head()
    elif fingerprint in known and not (_missing(known[fingerprint]) and os.path.exists(place)):
        head = _remembered(name_or_path, known[fingerprint])
    elif fingerprint and not os.path.exists(place):
        raise InputError(
            f"the head {str(name_or_path)!r} (fingerprint {fingerprint[:12]}) is not known on this "
            "machine; name its file once: pav import --head FILE"
        )
    else:
        head = _read(place, flame_version)[0]
    if fingerprint and head.fingerprint != fingerprint:
        raise InputError(
            f"the head {str(name_or_path)!r} found here has the fingerprint "
            f"{head.fingerprint[:12]}, another one than {fingerprint[:12]} that is asked for; "
            "its files were changed: name the right ones once with pav import --head FILE"
        )
    return head


def remember_head(path: str | Path, *, flame_version: str = "") -> HeadModel:
    """Reads a head file and remembers where it lies, under its fingerprint."""
    if str(path) == BUILTIN:
        return builtin_head()
    head, entry = _read(Path(path), flame_version)
    known = preferences.read(_SECTION)
    if known.get(head.fingerprint) != entry:
        preferences.write(_SECTION, {**known, head.fingerprint: entry})
    return head


def remembered_head(version: str = "", fingerprint: str = "") -> HeadModel | None:
    """The head of this fingerprint, or the only FLAME of this version, that is known on this
    machine; None where there is none, or several."""
    known = preferences.read(_SECTION)
    if fingerprint == builtin_head().fingerprint:
        return builtin_head()
    if fingerprint:
        found = [fingerprint] if fingerprint in known else []
    else:
        found = [k for k, e in known.items() if isinstance(e, dict) and e.get("version") == version]
        found = [k for k in found if not _missing(known[k])]
    return load_head(f"FLAME {version}", found[0]) if len(found) == 1 else None


def _read(path: Path, flame_version: str) -> tuple[HeadModel, dict[str, str]]:
    # what else there is may keep a reader waiting
    if not (os.path.isdir(path) or os.path.isfile(path)):
        raise InputError(f"{str(path)!r}: no such head file")
    path = path.absolute()
    if not looks_like_flame(path):
        return read_head(path), {"head": str(path)}
    files = find_flame(path, flame_version)
    head = _flame(files, _stamps(files))
    entry = {"version": head.name.removeprefix("FLAME ")}
    return head, entry | {
        f.name: str(getattr(files, f.name))
        for f in fields(files)
        if f.name != "version" and getattr(files, f.name)
    }


def _remembered(name: str | Path, entry: dict) -> HeadModel:
    gone = _missing(entry)
    if gone:
        raise InputError(
            f"the head {str(name)!r}: {gone} is no longer there; name the head's file again: "
            "pav import --head FILE"
        )
    if "head" in entry:
        return read_head(entry["head"])
    known = {f.name for f in fields(FlameFiles)} - {"version"}
    parts = {part: Path(path) for part, path in entry.items() if part in known}
    files = FlameFiles(version=entry.get("version", ""), **parts)  # type: ignore[arg-type]
    return _flame(files, _stamps(files))


def _missing(entry: object) -> str:
    """What of a remembered head's files is no longer there, "" if all are."""
    if not isinstance(entry, dict) or not ("head" in entry or "model" in entry):
        return "its file"
    paths = [str(path) for part, path in entry.items() if part != "version"]
    return next((path for path in paths if not os.path.isfile(path)), "")


def _stamps(files: FlameFiles) -> tuple[int, ...]:
    paths = [getattr(files, f.name) for f in fields(files) if f.name != "version"]
    return tuple(p.stat().st_mtime_ns for p in paths if p)


@lru_cache(maxsize=2)
def _flame(files: FlameFiles, stamps: tuple[int, ...]) -> HeadModel:
    """Read once a process, as long as the files stay as they are."""
    return read_flame(files)
