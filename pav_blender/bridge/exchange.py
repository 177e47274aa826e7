"""An animated mesh and its camera as Alembic or USD, through Blender's own exporters."""

from __future__ import annotations

import os
import struct
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ..core.collection import Clip, Collection
from ..core.errors import InputError, PavError
from .axes import points_to_blender
from .lens import from_intrinsics

_SUFFIXES = {"abc": (".abc",), "usd": (".usd", ".usda", ".usdc", ".usdz")}
_OPTIONS = {"abc": "alembic", "usd": "usd"}
_LONGEST = 100_000  # frame numbers between the first and the last


def export_animated(
    collection: Collection, clip: Clip, out: Path, kind: str, fps: float
) -> tuple[int, int]:
    """Writes one clip's mesh and camera to `out`; returns the first and last frame number.

    Frame numbers are the clip's own; between frames that it lacks vertices go straight. Frames of
    held-out cameras are left out. Raises InputError for a wrong name or without Blender, PavError
    where Blender's exporter fails; nothing is left under `out` then.
    """
    if out.suffix not in _SUFFIXES[kind]:
        raise InputError(f"--out {out}: {kind} files end in {' or '.join(_SUFFIXES[kind])}")
    if not out.resolve().parent.is_dir():
        raise InputError(f"--out {out}: no such folder")
    if not fps > 0:
        raise InputError(f"--fps {fps}: above 0")
    try:
        import bpy
    except ImportError as error:
        raise InputError(
            f"--to {kind} needs Blender: `blender --command pav export ...`, or `pip install bpy`"
        ) from error
    if not getattr(bpy.app.build_options, _OPTIONS[kind], True):
        raise InputError(
            f"--to {kind}: this Blender was built without {kind.upper()}, as some distributions' "
            "are; use one from blender.org, or `pip install bpy`"
        )
    from .scene import filmed_rows

    rows = filmed_rows(clip)
    numbers = clip.frame_id[rows]
    first, last = int(numbers[0]), int(numbers[-1])
    if last - first > _LONGEST:
        raise InputError(f"clip {clip.name}: frame numbers {first} to {last} are too far apart")
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    with tempfile.TemporaryDirectory(prefix=".partial-", dir=out.resolve().parent) as folder:
        scene = _settings(clip, first, last, fps)
        mesh = _add_mesh(collection, clip.name)
        _play(mesh, Path(folder) / "motion.pc2", collection.posed(clip, rows), numbers)
        _add_camera(scene, clip, rows)
        temporary = Path(folder) / out.name
        _write(kind, temporary, first, last)
        if not temporary.is_file():
            raise PavError(f"{out}: Blender's exporter wrote nothing")
        os.replace(temporary, out)
        bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)  # lets go of the folder
    return first, last


def _settings(clip: Clip, first: int, last: int, fps: float) -> Any:
    import bpy

    from .scene import frame_rate

    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = first, last
    scene.render.resolution_x, scene.render.resolution_y = clip.width, clip.height
    scene.render.resolution_percentage = 100
    scene.render.fps, scene.render.fps_base = frame_rate(fps)
    return scene


def _add_mesh(collection: Collection, name: str) -> Any:
    import bpy

    from .rig import mesh_object

    head = collection.head
    return mesh_object(head, head.shaped(collection.betas), name, bpy.context.scene.collection)


def _play(mesh: Any, path: Path, posed: np.ndarray, numbers: np.ndarray) -> None:
    """Moves the mesh by a point cache: vertices [F, V, 3] at frame numbers [F], rising."""
    first, last = int(numbers[0]), int(numbers[-1])
    with path.open("wb") as stream:
        # PC2: sign, version, points, first frame, frames a sample, samples
        count = last - first + 1
        stream.write(struct.pack("<12siiffi", b"POINTCACHE2", 1, posed.shape[1], first, 1, count))
        for number in range(first, last + 1):
            after = int(np.searchsorted(numbers, number))
            before = after if numbers[after] == number else after - 1
            span = max(int(numbers[after] - numbers[before]), 1)
            part = np.float32((number - numbers[before]) / span)
            points = posed[before] + part * (posed[after] - posed[before])
            stream.write(np.ascontiguousarray(points_to_blender(points), "<f4").tobytes())
    modifier = mesh.modifiers.new("Motion", "MESH_CACHE")
    modifier.cache_format, modifier.filepath = "PC2", str(path)
    modifier.frame_start = first


def _add_camera(scene: Any, clip: Clip, rows: np.ndarray) -> None:
    import bpy

    from .motion import apply_camera

    name = f"{clip.name} camera"
    camera = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    scene.collection.objects.link(camera)
    scene.camera = camera
    lenses = [from_intrinsics(k, clip.width, clip.height) for k in clip.intrinsics[rows]]
    camera.data.clip_start = 0.01
    camera.data.sensor_fit = lenses[0].sensor_fit
    camera.data.sensor_width = lenses[0].sensor_width
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = (
        lenses[0].aspect_x,
        lenses[0].aspect_y,
    )
    apply_camera(camera, clip.frame_id[rows].astype(float), clip.camera_to_world[rows], lenses)


def _write(kind: str, path: Path, first: int, last: int) -> None:
    import bpy

    try:
        if kind == "abc":
            bpy.ops.wm.alembic_export(
                filepath=str(path), start=first, end=last, evaluation_mode="RENDER",
                as_background_job=False,
            )  # fmt: skip
        else:
            bpy.ops.wm.usd_export(
                filepath=str(path), export_animation=True, evaluation_mode="RENDER",
                export_materials=False, export_armatures=False, export_shapekeys=False,
            )  # fmt: skip
    except RuntimeError as error:
        reason = next((line for line in str(error).splitlines() if line.strip()), "no reason given")
        raise PavError(f"{path.name}: {reason}") from error
