"""VHAP's exports and what GaussianAvatars' users combine of them: the head moves, y is up.

A combined folder names files of its neighbours (`../SEQUENCE/images/...`), the only place where
a clip's name is left; nothing beyond the folder's parent is read.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from .parsed import POSE_JOINTS, VERTICES, ParsedClip, Picture, stacked
from .rotations import OPENGL
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

TITLE = "VHAP"
TEETH = 120
_MOST = 10_000  # coefficients of any head
_FILES = ("transforms.json", "transforms_train.json", "transforms_val.json", "transforms_test.json")


def looks_like(path: Path) -> bool:
    """A folder with transforms whose frames name FLAME parameters."""
    frames = (first_frame(peek_json(path / name)) for name in _FILES)
    return any("flame_param_path" in frame for frame in frames)


def read(path: Path, name: str, tell: Tell = None) -> list[ParsedClip]:
    """One clip a sequence and camera; sequences of a combined folder are told apart again."""
    source = Source(path, siblings=True)
    groups, splits = _groups(source)
    sequences = list(dict.fromkeys(sequence for sequence, _ in groups))
    cameras = {sequence: sum(s == sequence for s, _ in groups) for sequence in sequences}
    cache = _Parameters(source)
    clips = []
    for (sequence, camera), frames in groups.items():
        parts = [name if len(sequences) == 1 else sequence or name]
        if cameras[sequence] > 1:
            parts.append(f"cam{camera}")
        clip = _read(source, "_".join(parts), frames, splits, cache, tell)
        clip.appearance = name
        clips.append(clip)
    return clips


def _groups(source: Source) -> tuple[dict[tuple[str, str], dict[str, dict]], dict[str, str]]:
    """Frames by (sequence, camera) and file_path, and the split of each that has one."""
    groups: dict[tuple[str, str], dict[str, dict]] = {}
    found: dict[str, str] = {}
    seen: dict[str, set[str]] = {}
    for name in _FILES:
        if not source.find(name):
            continue
        kind = name.removeprefix("transforms").removesuffix(".json").lstrip("_")
        for frame in frames_of(source.json(name), source.root / name):
            key = frame.get("file_path")
            source.path(key)
            assert isinstance(key, str)
            camera = str(frame.get("camera_id", frame.get("camera_index", 0)))
            match = re.match(r"\.\./([^/]+)/", key.replace("\\", "/"))
            groups.setdefault((match[1] if match else "", camera), {}).setdefault(key, frame)
            if kind:
                found[key] = kind
                seen.setdefault(kind, set()).add(camera)
    if not groups:
        raise InputError(f"{source.root}: its transforms have no frames")
    # val holds out a camera where there are several; else frames, as test does
    view = bool(seen.get("val")) and not seen["val"] & seen.get("train", set())
    names = {"train": "train", "test": "test", "val": "view" if view else "test"}
    return groups, {key: names.get(kind, "train") for key, kind in found.items()}


class _Parameters:
    """Frames' parameters, each file read once for all cameras. An offset that is static is kept
    once for the folder, whose files all repeat it."""

    def __init__(self, source: Source) -> None:
        self.lost: set[str] = set()
        self.head = exported_head(source)
        self._source = source
        self._rows: dict[str, dict[str, np.ndarray]] = {}
        self._offsets: dict[str, np.ndarray | None] = {}

    def row(self, name: str) -> dict[str, np.ndarray]:
        if name not in self._rows:
            what = f"{self._source.root}: {name}"
            content = self._source.arrays(name)
            row = flame_parameters(content, what, self.lost, any_head=bool(self.head))
            if self.head:
                row |= _of_ours(content, what)
            self._offsets.setdefault(name.rpartition("/")[0], row.pop("offset", None))
            self._rows[name] = row
        return self._rows[name]

    def offset(self, name: str) -> np.ndarray | None:
        return self._offsets.get(name.rpartition("/")[0])


def _read(
    source: Source,
    name: str,
    frames: dict[str, dict],
    splits: dict[str, str],
    cache: _Parameters,
    tell: Tell,
) -> ParsedClip:
    rows: list[dict[str, Any]] = []
    skipped: list[str] = []
    shapes, size, parameters = [], None, ""
    for key, frame in counted(frames.items(), tell):
        image = source.picture(key)
        parameters = str(frame.get("flame_param_path", ""))
        if image is None or source.find(parameters) is None:
            what = "picture is" if image is None else "FLAME parameters are"
            skipped.append(f"{key}: its {what} missing")
            continue
        row = dict(cache.row(parameters))
        shapes.append(row.pop("shape"))
        matte = source.picture(frame["fg_mask_path"]) if frame.get("fg_mask_path") else None
        camera, intrinsics, here = _camera(frame, f"{source.root}: {key}")
        if size not in (None, here):
            raise InputError(f"{source.root}: {key}: {here} pixels; frames before have {size}")
        size = here
        rows.append(
            row
            | {
                "frame_id": _number(key, frame, ours=bool(cache.head)),
                "picture": Picture(image, matte),
                "split": splits.get(key, "train"),
                "intrinsics": intrinsics,
                "camera_to_world": camera,
            }
        )
    if size is None:
        why = f" ({skipped[0]})" if skipped else ""
        raise InputError(f"{source.root}: {name}: no frame can be used{why}")
    return stacked(
        name,
        TITLE,
        rows,
        flame="2023",
        width=size[0],
        height=size[1],
        shape=np.mean(shapes, 0),
        offset=cache.offset(parameters),
        head=cache.head,
        skipped=skipped,
        lost=sorted(cache.lost),
    )


def _of_ours(content: dict[str, np.ndarray], what: str) -> dict[str, np.ndarray]:
    """What `pav export` adds to a frame: the posed mesh, and eyelids that FLAME's files lack."""
    row = {"vertices": numbers(content.get("vertices"), (1, -1, 3), f"{what}: vertices")[0]}
    if "eyelids" in content:
        row["eyelids"] = numbers(content["eyelids"], (1, 2), f"{what}: eyelids")[0]
    return row


def flame_parameters(
    content: dict[str, np.ndarray], what: str, lost: set[str], *, any_head: bool = False
) -> dict[str, np.ndarray]:
    """A frame's npz as a row: shape, expression, pose, translation, offsets without the teeth.

    any_head: it may have other counts than FLAME has.
    """
    sizes = {"translation": 3, "rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6}
    values = {}
    for key, count in sizes.items():
        if key not in content:
            raise InputError(f"{what}: {key} is missing")
        values[key] = numbers(content[key], (1, count), f"{what}: {key}")[0]
    if "shape" not in content or "expr" not in content:
        raise InputError(f"{what}: shape or expr is missing")
    shape = numbers(np.ravel(content["shape"]), (-1,), f"{what}: shape")
    expression = numbers(np.ravel(content["expr"]), (-1,), f"{what}: expr")
    if max(len(shape) - 300, len(expression) - 100) > (_MOST if any_head else 0):
        raise InputError(f"{what}: {len(shape)} shapes, {len(expression)} expressions; not FLAME")
    pose = np.concatenate(
        [values[k] for k in ("rotation", "neck_pose", "jaw_pose", "eyes_pose")]
    ).reshape(POSE_JOINTS, 3)
    row = {
        "shape": np.pad(shape, (0, max(0, 300 - len(shape)))),
        "expression": np.pad(expression, (0, max(0, 100 - len(expression)))),
        "pose": pose,
        "translation": values["translation"],
    }
    for key, ours in (("static_offset", "offset"), ("dynamic_offset", "moving_offset")):
        if key not in content:
            continue
        offset = np.asarray(content[key])
        offset = offset[0] if offset.ndim == 3 and len(offset) == 1 else offset
        fits = offset.ndim == 2 and offset.shape[1:] == (3,)
        if not fits or not (any_head or len(offset) in (VERTICES, VERTICES + TEETH)):
            raise InputError(
                f"{what}: {key} has shape {list(offset.shape)}; {VERTICES} vertices or "
                f"{VERTICES + TEETH} with teeth are needed"
            )
        if len(offset) == VERTICES + TEETH:
            offset = offset[:VERTICES]
            lost.add(f"the {TEETH} vertices of VHAP's own teeth")
        row[ours] = offset.astype(np.float32)
    if "offset" in row and not np.isfinite(row["offset"]).all():
        raise InputError(f"{what}: static_offset is not finite")
    if not np.isfinite(row["shape"]).all():
        raise InputError(f"{what}: shape is not finite")
    return row


def _camera(frame: dict, what: str) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    to_world = numbers(frame.get("transform_matrix"), (4, 4), what) @ OPENGL
    rotation_checked(to_world[:3, :3], what)
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    fx, fy, cx, cy, width, height = (
        float(numbers(frame.get(key), (), f"{what}: {key}")) for key in keys
    )
    if not (1 <= width <= 16384 and 1 <= height <= 16384 and fx > 0 and fy > 0):
        raise InputError(f"{what}: a picture of {width}x{height}, focal lengths {fx} and {fy}")
    intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return to_world, intrinsics, (int(width), int(height))


def _number(key: str, frame: dict, *, ours: bool) -> int:
    """The time step in a picture's name TTTTT_CC, which restarts with each sequence; in what we
    exported the frame's own number."""
    own = number_in(str(frame.get("timestep_id", ""))) if ours else None
    if own is not None:
        return own
    match = re.search(r"(\d{1,9})_(\d+)\.\w+$", key)
    step = int(match[1]) if match else frame.get("timestep_index")
    if not isinstance(step, int) or not 0 <= step < 10**9:
        raise InputError(f"{key}: the frame has no time step")
    return step
