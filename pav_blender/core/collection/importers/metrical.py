"""metrical-tracker's output: a checkpoint a frame; the head is still and the camera moves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...pickles import read_torch
from .meshes import read_vertices
from .parsed import ParsedClip, Picture, padded_pose, stacked
from .rotations import axis_angle_of_6d
from .source import Source, Tell, counted, number_in, numbers, rotation_checked

TITLE = "metrical-tracker"
_MATTES = ("matte", "alpha", "mask")  # it writes none; a user's own may lie beside its pictures
_SIZES = {"exp": 100, "shape": 300, "eyes": 12, "jaw": 6}


def looks_like(path: Path) -> bool:
    """A folder with `checkpoint/*.frame` and the pictures beside it."""
    return any((path / "checkpoint").glob("*.frame")) and not (path / "imgs").is_dir()


def read(path: Path, name: str, tell: Tell = None) -> list[ParsedClip]:
    """One clip; `mesh/*.ply`, where they are, decide what parameters leave open."""
    source = Source(path)

    def picture(frame: str) -> Picture | None:
        for folder in ("input", "images"):
            image = source.picture(f"{folder}/{frame}")
            if image:
                mattes = (source.picture(f"{matte}/{frame}") for matte in _MATTES)
                return Picture(image, next((m for m in mattes if m), None))
        return None

    return [read_checkpoints(source, name, TITLE, picture, tell)]


def read_checkpoints(
    source: Source,
    name: str,
    tool: str,
    picture: Callable[[str], Picture | None],
    tell: Tell = None,
    habit: int = 0,
) -> ParsedClip:
    """Every checkpoint of a source; picture: of the checkpoint called so, None where missing."""
    rows, skipped, size = [], [], None
    shapes = []
    files = sorted((source.root / "checkpoint").glob("*.frame"))
    for file in counted(files, tell):
        place = source.path(f"checkpoint/{file.name}")
        content = read_torch(place)
        frame = _name(content, place)
        found = picture(frame)
        if found is None:
            skipped.append(f"{place.name}: its picture {frame} is missing")
            continue
        row, shape, size_here = _row(content, place)
        if size is not None and size_here != size:
            raise InputError(f"{place}: img_size {size_here}; the frames before have {size}")
        size = size_here
        mesh = source.find(f"mesh/{file.stem}.ply")
        rows.append(
            row
            | {"frame_id": number_in(frame), "picture": found}
            | ({"vertices": read_vertices(mesh)} if mesh else {})
        )
        shapes.append(shape)
    if size is None:
        why = f" ({skipped[0]})" if skipped else ""
        raise InputError(f"{source.root}: no usable checkpoint{why}")
    height, width = size
    return stacked(
        name,
        tool,
        rows,
        flame="2020",
        width=width,
        height=height,
        shape=np.mean(shapes, 0),
        habit=habit,
        skipped=skipped,
        lost=["albedo and lighting coefficients", "depth maps"],
    )


def _name(content: Any, path: Path) -> str:
    name = content.get("frame_id", path.stem) if isinstance(content, dict) else None
    name = str(name)
    if not name.isascii() or not name.replace("_", "").replace("-", "").isalnum():
        raise InputError(f"{path}: frame_id {name!r} is not a frame's name")
    if number_in(name) is None:
        raise InputError(f"{path}: frame_id {name!r} has no number")
    return name


def _row(content: Any, path: Path) -> tuple[dict[str, Any], np.ndarray, tuple[int, int]]:
    if not isinstance(content, dict):
        raise InputError(f"{path}: not a checkpoint of metrical-tracker")
    flame, camera = content.get("flame"), content.get("opencv")
    if not isinstance(flame, dict) or not isinstance(camera, dict):
        raise InputError(f"{path}: a checkpoint without 'flame' or 'opencv'")
    values = {}
    for key, count in _SIZES.items():
        value = numbers(flame.get(key), (1, -1), f"{path}: flame/{key}")[0]
        if len(value) > count or (key in ("eyes", "jaw") and len(value) != count):
            raise InputError(f"{path}: flame/{key} has {len(value)} numbers, not {count}")
        values[key] = np.pad(value, (0, count - len(value)))
    lids = numbers(flame.get("eyelids", [[0.0, 0.0]]), (1, 2), f"{path}: flame/eyelids")[0]
    rotation = numbers(camera.get("R"), (1, 3, 3), f"{path}: opencv/R")[0]
    rotation_checked(rotation, str(path))
    place = numbers(camera.get("t"), (1, 3), f"{path}: opencv/t")[0]
    intrinsics = numbers(camera.get("K"), (1, 3, 3), f"{path}: opencv/K")[0]
    size = numbers(content.get("img_size"), (2,), f"{path}: img_size")
    if not (np.isfinite(size).all() and (size >= 1).all() and (size <= 16384).all()):
        raise InputError(f"{path}: img_size is {size.tolist()}")
    to_world = np.eye(4)
    to_world[:3, :3] = rotation.T
    to_world[:3, 3] = -rotation.T @ place
    row = {
        "expression": values["exp"],
        "pose": padded_pose(
            jaw=axis_angle_of_6d(values["jaw"]),
            left_eye=axis_angle_of_6d(values["eyes"][:6]),
            right_eye=axis_angle_of_6d(values["eyes"][6:]),
        ),
        "eyelids": lids,
        "translation": np.zeros(3),
        "intrinsics": intrinsics,
        "camera_to_world": to_world,
    }
    return row, values["shape"], (int(size[0]), int(size[1]))
