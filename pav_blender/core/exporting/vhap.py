"""VHAP's layout, which GaussianAvatars reads: one folder a clip. The camera rests, the head moves.

A head that is not FLAME's has other coefficients than FLAME: each `flame_param` file also holds
the posed vertices themselves, in the world of the cameras. FLAME's gets as an offset what its
coefficients leave out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..collection import Clip, Collection
from ..collection.importers.rotations import OPENGL
from ..collection.importers.vhap import TEETH
from ..files import new_folder, replacing
from ..head import HeadModel
from ..head.flame import EXPRESSIONS, EYELIDS, version_of
from ..images import write_gray
from ..progress import Report
from ..training.frames import load_picture
from .layout import (
    copy_picture,
    expressions_of,
    padded,
    pinhole,
    write_head_file,
    write_names,
    write_transforms,
)
from .meshes import ObjWriter, posed_rows
from .offsets import offset_to

SHAPES = 300
_CANONICAL_JAW = 0.3  # radians
# theirs: our joints, in order; their rotation is that of the first joint, whatever its name
_JOINTS = {
    "neck_pose": ("neck",),
    "jaw_pose": ("jaw",),
    "eyes_pose": ("left_eye", "right_eye"),
}


def export_vhap(
    collection: Collection, clips: list[Clip], out: Path, *, progress: Report | None = None
) -> int:
    """Writes `out`/<clip>/ for each clip as VHAP exports it; returns how many frames.

    images, fg_masks, flame_param, canonical_flame_param.npz, transforms. Timesteps
    count from 0 whatever the frames' numbers; held-out cameras from 1.
    """
    total, done = sum(len(clip) for clip in clips), 0
    with new_folder(out) as root:
        write_head_file(root, collection)
        for clip in clips:
            folder = root / clip.name
            folder.mkdir()
            canonical = collection.head.canonical(collection.betas)
            ObjWriter(collection.head).write(folder / "canonical.obj", canonical)
            write_names(folder, collection)
            _write_rest(collection, folder)
            steps, cameras = _timesteps(clip), _cameras(clip)
            frames: list[dict[str, Any]] = [{} for _ in range(len(clip))]
            for row, vertices in posed_rows(collection, clip):
                step, camera = int(steps[row]), int(cameras[row])
                frames[row] = _frame(collection, clip, row, vertices, folder, step, camera)
                done += 1
                if progress:
                    progress(done / total, frame=f"{clip.name}/{step:05d}")
            order = np.argsort(steps)
            write_transforms(folder, {}, [frames[row] for row in order], clip.split[order].tolist())
    return total


def _timesteps(clip: Clip) -> np.ndarray:
    """0 ... F - 1 by rising frame number: readers of this layout count."""
    steps = np.empty(len(clip), int)
    steps[np.argsort(clip.frame_id, kind="stable")] = np.arange(len(clip))
    return steps


def _cameras(clip: Clip) -> np.ndarray:
    """0 for the clip's own camera, 1, 2, ... for each held-out one."""
    cameras = np.zeros(len(clip), int)
    known: list[bytes] = []
    for row in clip.indices("view"):
        key = clip.camera_to_world[row].tobytes() + clip.intrinsics[row].tobytes()
        if key not in known:
            known.append(key)
        cameras[row] = 1 + known.index(key)
    return cameras


def _frame(
    collection: Collection,
    clip: Clip,
    row: int,
    vertices: np.ndarray,
    folder: Path,
    step: int,
    camera: int,
) -> dict[str, Any]:
    """Writes the files of a frame; its entry in transforms.json."""
    name = f"{step:05d}_{camera:02d}.png"
    rgba = load_picture(collection, clip, row)
    copy_picture(collection, clip, row, folder / "images" / name)
    write_gray(folder / "fg_masks" / name, np.ascontiguousarray(rgba[..., 3]))
    values = _parameters(collection, clip.expression[row], clip.pose[row], clip.translation[row])
    more = _beyond(collection, clip, row, vertices)
    frame = {**values, **more, "vertices": vertices[None]}
    _write_npz(folder / "flame_param" / f"{step:05d}.npz", frame)
    return {
        "timestep_index": step,
        "timestep_id": f"{clip.frame_id[row]:05d}",
        "camera_index": camera,
        "camera_id": f"{camera:02d}",
        **pinhole(clip, row),
        "h": clip.height,
        "w": clip.width,
        "transform_matrix": (clip.camera_to_world[row].astype(float) @ OPENGL).tolist(),
        "file_path": f"images/{name}",
        "fg_mask_path": f"fg_masks/{name}",
        "flame_param_path": f"flame_param/{step:05d}.npz",
    }


def _parameters(
    collection: Collection, expression: np.ndarray, pose: np.ndarray, translation: np.ndarray
) -> dict[str, np.ndarray]:
    """VHAP's names for one frame's coefficients; joints that the head lacks are 0."""
    head = collection.head
    by_name = dict(zip(head.joint_names, pose, strict=True))
    values = {
        theirs: np.concatenate([by_name.get(joint, np.zeros(3)) for joint in ours])[None]
        for theirs, ours in _JOINTS.items()
    }
    values["rotation"] = pose[None, 0]
    offset = collection.head_offset
    offset = np.zeros_like(head.template) if offset is None else offset
    return {
        "translation": translation[None].astype(np.float32),
        **{key: value.astype(np.float32) for key, value in values.items()},
        "shape": padded(collection.betas, SHAPES),
        "expr": expressions_of(head, expression)[None],
        "static_offset": _with_teeth(head, offset)[None],
    }


def _beyond(
    collection: Collection, clip: Clip, row: int, vertices: np.ndarray
) -> dict[str, np.ndarray]:
    """What FLAME's coefficients do not say, as peers that run FLAME can take it: `dynamic_offset`;
    and the eyelids' own coefficients. Other heads' meshes are taken as they are."""
    head = collection.head
    if not version_of(head):
        return {}
    lids = [head.expression_names.index(name) for name in EYELIDS if name in head.expression_names]
    values = {"eyelids": clip.expression[row, lids][None]} if lids else {}
    if clip.vertices is None and not clip.expression[row, EXPRESSIONS:].any():
        return values
    moved = clip.expression[row, :EXPRESSIONS], clip.pose[row], clip.translation[row]
    offset = offset_to(head, collection.betas, *moved, vertices)
    return values | {"dynamic_offset": _with_teeth(head, offset)[None]}


def _with_teeth(head: HeadModel, offset: np.ndarray) -> np.ndarray:
    """FLAME's offsets [5023, 3] with room for the teeth that VHAP adds; others as they are."""
    teeth = TEETH if version_of(head) else 0
    return np.pad(offset, ((0, teeth), (0, 0))).astype(np.float32)


def _write_rest(collection: Collection, folder: Path) -> None:
    """What holds for the whole clip: the pose at rest."""
    head = collection.head
    pose = np.zeros((len(head.joint_names), 3), np.float32)
    if "jaw" in head.joint_names:
        pose[head.joint_names.index("jaw"), 0] = _CANONICAL_JAW
    still = np.zeros(len(head.expression_names), np.float32)
    values = _parameters(collection, still, pose, np.zeros(3, np.float32))
    _write_npz(folder / "canonical_flame_param.npz", values)


def _write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    path.parent.mkdir(exist_ok=True)
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]
