"""VHAP's own track of a monocular video, not exported: all frames in one npz, the head moves."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from .parsed import ParsedClip, Picture, stacked
from .rotations import OPENGL
from .source import Source, Tell, counted, number_in, numbers
from .vhap import flame_parameters

TITLE = "VHAP track"
_FRAMES = ("translation", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "expr")
_FILE = re.compile(r"tracked_flame_params(?:_(\d+))?\.npz")


def looks_like(path: Path) -> bool:
    return _track(path) is not None


def read(path: Path, name: str, tell: Tell = None) -> list[ParsedClip]:
    """One clip. The pictures are looked for in `images` beside the track, or above it."""
    source = Source(path)
    file = _track(path)
    assert file is not None
    content = source.arrays(str(file.relative_to(path)))
    for key in (*_FRAMES, "shape", "timestep_id"):
        if key not in content:
            raise InputError(f"{file}: {key} is missing")
    if "focal_length" not in content:
        raise InputError(
            f"{file}: a track without a focal length, made with calibrated cameras that it does "
            "not hold; import VHAP's export instead"
        )
    timed = [key for key in (*_FRAMES, "dynamic_offset") if key in content]
    count = np.size(content["timestep_id"])
    if any(np.shape(content[key])[:1] != (count,) for key in ("timestep_id", *timed)):
        raise InputError(f"{file}: its arrays differ in their number of frames")
    height, width = _size(content, file)
    lengths = np.ravel(numbers(content["focal_length"], (-1,), "focal_length"))
    focal = float(lengths[0]) if len(lengths) else 0.0
    if not 0 < focal < 1e4:
        raise InputError(f"{file}: focal_length is {focal}")
    focal *= max(height, width)
    to_world = OPENGL.copy()
    to_world[2, 3] = 1.0  # VHAP's camera stands a metre before the origin and looks down -z
    rows: list[dict[str, Any]] = []
    skipped: list[str] = []
    lost = {"the texture"}
    shape = offset = None
    for at, step in counted(list(enumerate(content["timestep_id"].tolist())), tell):
        step = f"{step:05d}" if isinstance(step, int) else str(step)
        image = source.picture(f"images/{step}")
        if image is None:
            skipped.append(f"{step}: its picture images/{step} is missing")
            continue
        one = {key: content[key][at : at + 1] for key in _FRAMES} | {"shape": content["shape"]}
        if "static_offset" in content:
            one["static_offset"] = content["static_offset"]
        if "dynamic_offset" in content:
            one["dynamic_offset"] = content["dynamic_offset"][at : at + 1]
        row: dict[str, Any] = flame_parameters(one, f"{file}: frame {step}", lost)
        shape, offset = row.pop("shape"), row.pop("offset", None)
        number = number_in(step)
        mattes = (source.picture(f"{folder}/{step}") for folder in ("alpha_maps", "fg_masks"))
        rows.append(
            row
            | {
                "frame_id": at if number is None else number,
                "picture": Picture(image, next((m for m in mattes if m), None)),
                "intrinsics": [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]],
                "camera_to_world": to_world,
            }
        )
    if not rows:
        raise InputError(
            f"{path}: no picture of the track is there ({skipped[0]}); put VHAP's images and "
            "alpha_maps beside it, or import its export"
        )
    return [
        stacked(
            name, TITLE, rows, flame="2023", width=width, height=height, shape=shape,
            offset=offset, skipped=skipped, lost=sorted(lost),
        )
    ]  # fmt: skip


def _track(path: Path) -> Path | None:
    """The latest epoch's file in the folder, or in one of its own folders."""
    places = [*path.glob("tracked_flame_params*.npz"), *path.glob("*/tracked_flame_params*.npz")]
    found = [(int(m[1] or 0), p) for p in places if (m := _FILE.fullmatch(p.name))]
    return max(found)[1] if found else None


def _size(content: dict[str, np.ndarray], file: Path) -> tuple[int, int]:
    size = np.ravel(numbers(np.ravel(content.get("image_size", ())), (-1,), f"{file}: image_size"))
    if len(size) < 2 or not ((size[:2] >= 1) & (size[:2] <= 16384)).all():
        raise InputError(f"{file}: image_size (height, width) is missing or wrong")
    return int(size[0]), int(size[1])
