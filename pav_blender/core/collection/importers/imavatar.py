"""IMavatar's `flame_params.json`, also of PointAvatar and others: FLAME four times as large."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...images import read_rgba
from .labels import PARSING
from .parsed import POSE_JOINTS, ParsedClip, Picture, stacked
from .rotations import OPENGL
from .source import Source, Tell, counted, frames_of, number_in, numbers, rotation_checked

TITLE = "IMavatar"
FILE = "flame_params.json"
_SCALE = 4.0
_OLD_SIZE = 512  # what pixel intrinsics of older files refer to


def looks_like(path: Path) -> bool:
    """A folder with flame_params.json, or one whose folders have it."""
    return bool(_folders(path))


def read(path: Path, name: str, tell: Tell = None) -> list[ParsedClip]:
    """A clip for each folder that has the file."""
    source = Source(path)
    folders = _folders(path)
    clips = []
    for folder in folders:
        inner = Source(source.path(folder.name)) if folder != path else source
        clips.append(_read(inner, name if len(folders) == 1 else f"{name}_{folder.name}", tell))
    return clips


def _folders(path: Path) -> list[Path]:
    if (path / FILE).is_file():
        return [path]
    return sorted(p.parent for p in path.glob(f"*/{FILE}"))


def _read(source: Source, name: str, tell: Tell) -> ParsedClip:
    file = source.root / FILE
    content = source.json(FILE)
    frames = frames_of(content, file)
    shape = numbers(content.get("shape_params"), (-1,), f"{file}: shape_params")
    lens = numbers(content.get("intrinsics"), (4,), f"{file}: intrinsics")
    if len(shape) > 300 or not (np.isfinite(shape).all() and np.isfinite(lens).all()):
        raise InputError(f"{file}: shape_params or intrinsics do not fit FLAME")
    rows: list[dict[str, Any]] = []
    skipped: list[str] = []
    for frame in counted(frames, tell):
        key = frame.get("file_path")
        image = source.find(key, (".png", ".jpg", ""))
        if image is None:
            skipped.append(f"{key}: its picture is missing")
            continue
        rows.append(_row(source, str(key), frame, image, f"{file}: {key}"))
    if not rows:
        why = f" ({skipped[0]})" if skipped else ""
        raise InputError(f"{file}: no frame can be used{why}")
    width, height = _size(rows[0]["picture"].image)
    scale = np.array([width, height, width, height])
    # the fourth tells: relative to the picture's size, or pixels of a picture of 512
    lens = lens * scale * (1 / _OLD_SIZE if lens[3] > 1 else 1)
    fx, fy, cx, cy = np.abs(lens[0]), np.abs(lens[1]), lens[2], lens[3]
    for row in rows:
        row["intrinsics"] = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    return stacked(
        name,
        TITLE,
        rows,
        flame="2020",
        width=width,
        height=height,
        shape=np.pad(shape, (0, 300 - len(shape))),
        skipped=skipped,
        lost=["2D keypoints and boxes"],
    )


def _row(source: Source, key: str, frame: dict, image: Path, what: str) -> dict[str, Any]:
    world = numbers(frame.get("world_mat"), (-1, 4), f"{what}: world_mat")[:3]
    if len(world) != 3:
        raise InputError(f"{what}: world_mat is not 3 by 4")
    rotation, place = rotation_checked(world[:, :3], what), world[:, 3] / _SCALE
    to_world = np.eye(4)
    to_world[:3, :3] = rotation.T @ OPENGL[:3, :3]  # it looks down -z, y up
    to_world[:3, 3] = -rotation.T @ place
    expression = numbers(frame.get("expression"), (-1,), f"{what}: expression")
    pose = numbers(frame.get("pose"), (3 * POSE_JOINTS,), f"{what}: pose")
    number = number_in(key)
    if number is None or len(expression) > 100:
        raise InputError(f"{what}: no frame number, or more than 100 expressions")
    matte, semantic = (source.find(_sibling(key, folder)) for folder in ("mask", "semantic"))
    return {
        "frame_id": number,
        "picture": Picture(image, matte, ((semantic, PARSING),) if semantic else ()),
        "expression": np.pad(expression, (0, 100 - len(expression))),
        "pose": pose.reshape(POSE_JOINTS, 3),
        "translation": np.zeros(3),
        "camera_to_world": to_world,
    }


def _sibling(key: str, folder: str) -> str:
    """./image/7 -> ./mask/7.png"""
    parts = key.replace("\\", "/").removesuffix(".png").split("/")
    parts[-2:-1] = [folder]
    return "/".join(parts) + ".png"


def _size(path: Path) -> tuple[int, int]:
    height, width = read_rgba(path).shape[:2]
    return width, height
