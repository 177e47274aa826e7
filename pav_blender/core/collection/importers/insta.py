"""INSTA's datasets: RGBA pictures, tracked meshes, expressions; the pose is in the meshes only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...reading import MIB, read_bytes
from .labels import INSTA as LABEL_TABLE
from .meshes import read_vertices
from .parsed import VERTICES, ParsedClip, Picture, padded_pose, stacked
from .source import (
    Source,
    Tell,
    counted,
    exported_head,
    first_frame,
    frames_of,
    number_in,
    numbers,
    peek_json,
    rotation_checked,
)

TITLE = "INSTA"
_MOST = 10_000  # expressions of any head
HELD_OUT = 350  # the last frames are the test set where no split is written down
_FILES = ("transforms.json", "transforms_train.json", "transforms_test.json", "transforms_val.json")


def looks_like(path: Path) -> bool:
    """A folder with transforms whose frames name a mesh."""
    frames = (first_frame(peek_json(path / name)) for name in _FILES)
    return any("mesh_path" in frame for frame in frames)


def read(path: Path, name: str, tell: Tell = None) -> list[ParsedClip]:
    """One clip. World: metres, FLAME's axes, the head still; cameras in OpenCV axes."""
    source = Source(path)
    frames, splits, top = _frames(source)
    head, canonical_path = exported_head(source), source.find("canonical.obj")
    count = None if head else VERTICES
    canonical = read_vertices(canonical_path, count) if canonical_path else None
    if canonical is not None:
        count = len(canonical)
    rows: list[dict[str, Any]] = []
    skipped: list[str] = []
    for key, frame in counted(frames.items(), tell):
        row = _row(source, key, frame, top, skipped, count)
        if row:
            rows.append(row | {"split": splits.get(key, "train")})
    width, height = (int(_value(top, {}, key)) for key in ("w", "h"))
    return [
        stacked(
            name,
            TITLE,
            rows,
            flame="2020",
            width=width,
            height=height,
            shape=None,
            canonical=canonical,
            head=head,
            habit=0 if splits else HELD_OUT,
            skipped=skipped,
            lost=["depth maps", "the meshes' own faces"],
        )
    ]


def _frames(source: Source) -> tuple[dict[str, dict], dict[str, str], dict[str, Any]]:
    """Frames by file_path, the split of each that has one written down, the intrinsics' file."""
    frames: dict[str, dict] = {}
    splits: dict[str, str] = {}
    top: dict[str, Any] = {}
    for name in _FILES:
        if not source.find(name):
            continue
        content = source.json(name)
        top = top or content
        for frame in frames_of(content, source.root / name):
            if "timestep_index" in frame:
                raise InputError(
                    f"{source.root / name}: VHAP's export of meshes; export FLAME parameters "
                    "(its mode 'param') instead, which hold the pose as well"
                )
            key = str(frame.get("file_path", ""))
            source.path(key)
            frames.setdefault(key, frame)
            if name != "transforms.json":
                # val is a part of test, and nothing that is tested on may be trained on
                held = name != "transforms_train.json" or splits.get(key) == "test"
                splits[key] = "test" if held else "train"
    if not frames:
        raise InputError(f"{source.root}: its transforms have no frames")
    return frames, splits, top


def _row(
    source: Source,
    key: str,
    frame: dict,
    top: dict[str, Any],
    skipped: list[str],
    vertices: int | None,
) -> dict[str, Any] | None:
    number, what = number_in(key), f"{source.root}: {key}"
    image = source.picture(key)
    mesh, expression = (source.find(frame.get(k)) for k in ("mesh_path", "exp_path"))
    for part, place in (("picture", image), ("mesh", mesh), ("expression", expression)):
        if place is None:
            skipped.append(f"{key}: its {part} is missing")
            return None
    assert image is not None
    assert mesh is not None
    assert expression is not None
    if number is None:
        raise InputError(f"{what}: the picture's name has no frame number")
    camera = numbers(frame.get("transform_matrix"), (4, 4), what)
    rotation_checked(camera[:3, :3], what)
    labels = source.find(frame["seg_mask_path"]) if frame.get("seg_mask_path") else None
    fx, fy, cx, cy = (_value(top, frame, k) for k in ("fl_x", "fl_y", "cx", "cy"))
    return {
        "frame_id": number,
        "picture": Picture(image, None, ((labels, LABEL_TABLE),) if labels else ()),
        "expression": _expression(expression, 100 if vertices == VERTICES else _MOST),
        "pose": padded_pose(),
        "translation": np.zeros(3),
        "intrinsics": np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        "camera_to_world": camera,
        "vertices": read_vertices(mesh, vertices),
    }


def _expression(path: Path, most: int) -> np.ndarray:
    try:
        values = np.array(read_bytes(path, MIB).split(), np.float64)
    except ValueError as error:
        raise InputError(f"{path}: not one coefficient a line ({error})") from error
    if not 0 < len(values) <= most:
        raise InputError(f"{path}: {len(values)} coefficients; the head has {most} at most")
    return np.pad(values, (0, max(0, 100 - len(values))))


def _value(top: dict[str, Any], frame: dict[str, Any], key: str) -> float:
    value = frame.get(key, top.get(key))
    if not isinstance(value, int | float) or not 0 < value < 1e6:
        raise InputError(f"transforms: {key} is {value!r}, a positive number is needed")
    return float(value)
