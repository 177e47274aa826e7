"""Frames as files: in which formats they are written, and what they say about themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..images import write_exr, write_rgba
from ..version import version
from .colour import linear_premultiplied

EMPTY_DEPTH = 1e10  # Blender's depth where nothing is


@dataclass(frozen=True)
class Format:
    """A file format of frames; `bits` a channel of colour."""

    name: str
    suffix: str
    bits: int


PNG8 = Format("png8", ".png", 8)
PNG16 = Format("png16", ".png", 16)
EXR = Format("exr", ".exr", 16)
FORMATS = {format.name: format for format in (PNG8, PNG16, EXR)}


def format_of(path: Path | str, name: str | None = None) -> Format:
    """The format called `name`, or the usual one of a path's ending; InputError where they do not
    go together."""
    suffix = Path(path).suffix
    if name is None:
        found = {".png": PNG8, ".exr": EXR}.get(suffix)
    else:
        found = FORMATS.get(name)
        if found is None:
            raise InputError(f"format {name!r}: one of {', '.join(FORMATS)}")
        if found.suffix != suffix:
            raise InputError(f"{path}: pictures of the format {name} end in {found.suffix}")
    if found is None:
        raise InputError(f"{path}: pictures end in .png or .exr")
    return found


def write_frame(
    path: Path,
    format: Format,
    straight: np.ndarray,
    linear: np.ndarray | None,
    depth: np.ndarray,
    metadata: dict[str, str],
) -> None:
    """Writes one frame, whole or not at all.

    straight [H, W, 4]: sRGB with straight alpha, which a PNG holds. linear [H, W, 4]:
    scene-linear, premultiplied, which an EXR holds as half (None: made of `straight`), with depth
    [H, W] (metres along the camera's axis, EMPTY_DEPTH or inf where nothing is) as float Z.
    """
    if format.suffix == ".exr":
        linear = linear_premultiplied(straight) if linear is None else linear
        write_exr(path, linear, np.where(np.isfinite(depth), depth, EMPTY_DEPTH), metadata)
    else:
        write_rgba(path, straight, bits=format.bits, metadata=metadata)


def provenance(
    avatars: Sequence[str], appearances: Sequence[str], frame: int, settings: str
) -> dict[str, str]:
    """What a frame's metadata say: who is seen (names of files, no folders: they differ between
    machines) wearing what, the frame's number, the settings, and this program's version."""
    return {
        "Software": f"pav_blender {version()}",
        "pav:avatar": ", ".join(avatars),
        "pav:appearance": ", ".join(appearances),
        "pav:frame": str(frame),
        "pav:settings": settings,
        "pav:version": version(),
    }
