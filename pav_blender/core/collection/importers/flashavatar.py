"""FlashAvatar: metrical-tracker's checkpoints with its own pictures, mattes and parsing.

Its pictures are numbered from 1 and the checkpoints from 0.
"""

from __future__ import annotations

from pathlib import Path

from ...errors import InputError
from .labels import MOUTH, NECK_AND_HEAD
from .metrical import read_checkpoints
from .parsed import ParsedClip, Picture
from .source import Source, Tell

TITLE = "FlashAvatar"
HELD_OUT = 500  # the frames its own evaluation holds out
_LATER = 1


def looks_like(path: Path) -> bool:
    """`imgs` beside `checkpoint`, or a root with `dataset` and `metrical-tracker/output`."""
    return _joined(path) or bool(_people(path))


def read(path: Path, name: str, tell: Tell = None) -> list[ParsedClip]:
    """A clip of a folder that holds both parts, or one a person of FlashAvatar's root."""
    source = Source(path)
    if _joined(path):
        return [_read(source, source, name, tell)]
    people = _people(path)
    clips = []
    for person in people:
        pictures = Source(source.path(f"dataset/{person}"))
        track = Source(source.path(f"metrical-tracker/output/{person}"))
        clips.append(_read(track, pictures, name if len(people) == 1 else f"{name}_{person}", tell))
    return clips


def _joined(path: Path) -> bool:
    return (path / "imgs").is_dir() and any((path / "checkpoint").glob("*.frame"))


def _people(path: Path) -> list[str]:
    folders = (path / "dataset").iterdir() if (path / "dataset").is_dir() else ()
    output = path / "metrical-tracker" / "output"
    return sorted(f.name for f in folders if (output / f.name / "checkpoint").is_dir())


def _read(track: Source, pictures: Source, name: str, tell: Tell) -> ParsedClip:
    if not (pictures.root / "imgs").is_dir():
        raise InputError(f"{pictures.root}: no folder imgs of pictures")

    def picture(frame: str) -> Picture | None:
        number = f"{int(frame) + _LATER:05d}" if frame.isdigit() else frame
        image = pictures.picture(f"imgs/{number}")
        if image is None:
            return None
        head = pictures.picture(f"parsing/{number}_neckhead")
        mouth = pictures.picture(f"parsing/{number}_mouth")
        layers = ((head, NECK_AND_HEAD), (mouth, MOUTH)) if head else ()
        labels = tuple((place, table) for place, table in layers if place)
        return Picture(image, pictures.picture(f"alpha/{number}"), labels)

    return read_checkpoints(track, name, TITLE, picture, tell, HELD_OUT)
