"""INSTA's layout: one folder a clip. The head rests, the camera moves round it.

INSTA fills a box round the canonical mesh and knows no turn of the head, so each frame's world is
moved rigidly until the skull lies where the canonical one does; what a picture shows is the same.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..collection import LABELS, Clip, Collection, read_labels
from ..collection.importers.labels import INSTA_CODES
from ..deformation.rigid import head_rotation
from ..errors import InputError
from ..files import new_folder, write_text
from ..images import write_gray, write_rgba
from ..progress import Report
from ..rendering.rasterise import rasterise
from ..training.frames import camera_of, load_picture
from ..training.prepare import rigid_weights
from .layout import (
    copy_picture,
    expressions_of,
    pinhole,
    write_head_file,
    write_names,
    write_transforms,
)
from .meshes import ObjWriter, posed_rows

DEPTH_SCALE = 0.001  # metres a step of a depth picture

# without labels: regions of the mesh, the later over the earlier
_REGIONS = (
    ("torso", "cloth"),
    ("neck", "neck"),
    ("scalp", "scalp_hair"),
    ("face", "face"),
    ("ears", "ears"),
    ("lips", "lips"),
    ("mouth_interior", "mouth"),
    ("eyeballs", "eyes"),
)


def export_insta(
    collection: Collection, clips: list[Clip], out: Path, *, progress: Report | None = None
) -> int:
    """Writes `out`/<clip>/ for each clip as INSTA reads it; returns how many frames.

    images, seg_mask, depth (of the tracked mesh), meshes, flame/exp, canonical.obj, transforms;
    names.json, by which our own importer knows the head again.
    Raises InputError where a clip's lens changes: INSTA has one a clip.
    """
    total, done = sum(len(clip) for clip in clips), 0
    with new_folder(out) as root:
        write_head_file(root, collection)
        for clip in clips:
            _check_lens(clip)
            folder = root / clip.name
            folder.mkdir()
            write_names(folder, collection)
            meshes, frames = ObjWriter(collection.head), []
            canonical = collection.head.canonical(collection.betas)
            meshes.write(folder / "canonical.obj", canonical)
            for row, vertices in posed_rows(collection, clip):
                frames.append(_frame(collection, clip, row, vertices, canonical, folder, meshes))
                done += 1
                if progress:
                    progress(done / total, frame=f"{clip.name}/{clip.frame_id[row]:05d}")
            write_transforms(folder, _top(clip), frames, clip.split.tolist())
    return total


def _check_lens(clip: Clip) -> None:
    away = np.abs(clip.intrinsics - clip.intrinsics[0]).reshape(len(clip), -1).max(1)
    if away.max() > 1e-2:
        raise InputError(
            f"clip {clip.name}: the lens of frame {clip.frame_id[int(away.argmax())]} differs from "
            "the first frame's; INSTA's layout has one lens a clip (VHAP's has one a frame)"
        )


def _top(clip: Clip) -> dict[str, Any]:
    lens = pinhole(clip, 0)
    return {
        "w": clip.width,
        "h": clip.height,
        **lens,
        "x_fov": float(np.degrees(lens["camera_angle_x"])),
        "y_fov": float(np.degrees(lens["camera_angle_y"])),
        "integer_depth_scale": DEPTH_SCALE,
    }


def _frame(
    collection: Collection,
    clip: Clip,
    row: int,
    vertices: np.ndarray,
    canonical: np.ndarray,
    folder: Path,
    meshes: ObjWriter,
) -> dict[str, Any]:
    """Writes the files of a frame; its entry in transforms.json."""
    name, camera = f"{clip.frame_id[row]:05d}", camera_of(clip, row)
    head = collection.head
    rgba = load_picture(collection, clip, row)
    copy_picture(collection, clip, row, folder / "images" / f"{name}.png")
    depth, triangle, _ = rasterise(vertices, head.triangles, camera)
    steps = np.where(np.isfinite(depth), depth / DEPTH_SCALE, 0)
    write_gray(folder / "depth" / f"{name}.png", np.clip(np.rint(steps), 0, 65535).astype("u2"))
    parts = _parts(collection, clip, row, triangle, rgba[..., 3])
    picture = np.repeat(parts[..., None], 4, 2)
    picture[..., 3] = 255
    write_rgba(folder / "seg_mask" / f"{name}.png", picture)
    still = resting(canonical, vertices, rigid_weights(head.regions, len(vertices)))
    rested = vertices.astype(np.float64) @ still[:3, :3].T + still[:3, 3]
    (folder / "meshes").mkdir(exist_ok=True)
    meshes.write(folder / "meshes" / f"{name}.obj", rested)
    coefficients = expressions_of(head, clip.expression[row]).tolist()
    write_text(
        folder / "flame" / "exp" / f"{name}.txt",
        "".join(f"{value:.8f}\n" for value in coefficients),
    )
    return {
        "transform_matrix": (still @ camera.camera_to_world).tolist(),
        "file_path": f"images/{name}.png",
        "mesh_path": f"meshes/{name}.obj",
        "exp_path": f"flame/exp/{name}.txt",
        "depth_path": f"depth/{name}.png",
        "seg_mask_path": f"seg_mask/{name}.png",
    }


def resting(canonical: np.ndarray, posed: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The rigid move [4, 4] that lays the skull of a posed mesh [V, 3] onto the canonical one's;
    weights [V]: which vertices move with the skull."""
    back = head_rotation(posed, canonical, weights).astype(np.float64)
    u, _, vt = np.linalg.svd(back)  # float32 above: a camera's axes stay of unit length
    move, w = np.eye(4), (weights / weights.sum()).astype(np.float64)
    move[:3, :3] = u @ vt
    move[:3, 3] = w @ canonical - move[:3, :3] @ (w @ posed)
    return move


def _parts(
    collection: Collection, clip: Clip, row: int, triangle: np.ndarray, alpha: np.ndarray
) -> np.ndarray:
    """INSTA's codes [H, W] uint8: of the labels, or where there are none of the mesh's regions;
    what stands off the mesh is hair then."""
    labels = read_labels(collection, clip, row)
    if labels is not None:
        return INSTA_CODES[labels]
    code = dict(zip(LABELS, INSTA_CODES, strict=True))
    codes = np.full(collection.head.vertex_count, code["face"], np.uint8)
    for region, part in _REGIONS:
        if region in collection.head.regions:
            codes[collection.head.regions[region]] = code[part]
    # a corner stands for its triangle: these are a few millimetres wide
    seen = codes[collection.head.triangles[triangle, 0]]
    return np.where(alpha > 127, np.where(triangle >= 0, seen, code["scalp_hair"]), 0).astype("u1")
