"""A saved scene through Blender's own render pipeline, as `blender -b FILE -a` does it."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

from ..core.errors import InputError, PavError
from ..core.progress import Report
from ..core.rendering.sequence import numbered
from .scene import blender, wear_only


def render_blend(
    blend: Path, appearance: str | None, out: str, *, progress: Report | None = None
) -> list[Path]:
    """Renders the frame range of a .blend wearing `appearance` alone ("all": each in turn; None:
    what the scene says, layers and keyframes and all); returns the paths.

    Every picture is rendered in a temporary folder beside its place and moved there whole. Raises
    InputError for a file without an avatar or an unknown appearance, PavError where Blender
    reports an error.
    """
    if not blend.is_file():
        raise InputError(f"{blend}: no such Blender file")
    with blender():
        import bpy

        try:
            bpy.ops.wm.open_mainfile(filepath=str(blend.resolve()))
        except RuntimeError as error:
            raise InputError(f"{blend}: not a Blender file ({_first_line(error)})") from error
        from . import avatars

        scene = bpy.context.scene
        heads = avatars.heads_of(scene.objects)
        if not heads:
            raise InputError(f"{blend}: no object in it wears an avatar; see `pav scene`")
        known = [avatars.looks(avatars.path_of(head.pav), head.pav.identity) for head in heads]
        names: list[str | None] = [*known[0]] if appearance == "all" else [appearance]
        written: list[Path] = []
        total = len(names) * (scene.frame_end - scene.frame_start + 1)
        for name in names:
            if name is not None:
                for head, looks in zip(heads, known, strict=True):
                    wear_only(head, looks, name)
            for frame in range(scene.frame_start, scene.frame_end + 1):
                path = numbered(out.replace("{appearance}", name or "scene"), frame)
                _render_frame(scene, frame, path)
                written.append(path)
                if progress:
                    progress(len(written) / total, picture=str(path))
    return written


def _render_frame(scene: Any, frame: int, path: Path) -> None:
    import bpy

    path.parent.mkdir(parents=True, exist_ok=True)
    scene.frame_set(frame)
    with tempfile.TemporaryDirectory(prefix=".partial-", dir=path.parent) as folder:
        temporary = Path(folder) / path.name
        scene.render.filepath = str(temporary)
        try:
            bpy.ops.render.render(write_still=True)
        except RuntimeError as error:
            raise PavError(f"frame {frame}: {_first_line(error)}") from error
        if not temporary.is_file():
            raise PavError(f"frame {frame}: Blender wrote no picture {path.name}")
        os.replace(temporary, path)


def _first_line(error: Exception) -> str:
    return next((line for line in str(error).splitlines() if line.strip()), "no reason given")
