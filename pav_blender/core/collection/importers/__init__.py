"""Importers: what other trackers and avatar systems wrote, as a collection.

One module a format: `TITLE`, `looks_like(path)`, `read(path, name, tell) -> list[ParsedClip]`;
`normalise` and `write_person` are common to all.
"""

from __future__ import annotations

import re
from pathlib import Path

from ...errors import InputError
from ...progress import Report
from . import flashavatar, imavatar, insta, metrical, nerface, vhap, vhap_track
from .normalise import NormalClip, Person, normalise
from .parsed import ParsedClip, Picture
from .write import write_person

# in the order in which a folder is tried
FORMATS = {
    "insta": insta,
    "vhap": vhap,
    "imavatar": imavatar,
    "flashavatar": flashavatar,
    "metrical": metrical,
    "vhap-track": vhap_track,
    "nerface": nerface,
}

__all__ = [
    "FORMATS",
    "NormalClip",
    "ParsedClip",
    "Person",
    "Picture",
    "detect",
    "normalise",
    "read_sources",
    "write_person",
]


def detect(path: Path) -> str:
    """The format of a folder; InputError where it looks like none of them."""
    if not path.is_dir():
        raise InputError(f"{path}: no such folder; a source is the folder its tool wrote")
    for name, module in FORMATS.items():
        if module.looks_like(path):
            return name
    known = ", ".join(sorted({module.TITLE for module in FORMATS.values()}))
    raise InputError(f"{path}: not a folder of {known}, as far as its files tell")


def split_name(source: str) -> tuple[str, Path]:
    """ "NAME=PATH" or "PATH" -> the name (of the folder, where none is given) and the path."""
    name, separator, path = source.partition("=")
    if separator and name and "/" not in name and "\\" not in name:
        return name, Path(path)
    place = Path(source)
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", place.resolve().name).lstrip("_.-")[:48]
    return plain or "clip", place


def read_sources(
    sources: list[str], format_name: str = "auto", progress: Report | None = None
) -> list[ParsedClip]:
    """Every clip of sources "PATH" or "NAME=PATH"; a source is an appearance, called NAME."""
    if format_name != "auto" and format_name not in FORMATS:
        raise InputError(f"--format {format_name!r}: auto, {', '.join(FORMATS)}")
    clips = []
    for at, source in enumerate(sources):
        name, path = split_name(source)
        found = detect(path) if format_name == "auto" else format_name
        if not path.is_dir():
            raise InputError(f"{path}: no such folder; a source is the folder its tool wrote")

        def tell(part: float, at: int = at, name: str = name) -> None:
            if progress:
                progress((at + part) / len(sources), source=name)

        for clip in FORMATS[found].read(path, name, tell):
            clip.name = re.sub(r"[^A-Za-z0-9_.-]+", "_", clip.name)[:64]
            clip.appearance = clip.appearance or name
            clips.append(clip)
    return clips
