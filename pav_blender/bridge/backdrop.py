"""A clip's pictures behind the head, in its camera's view."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

_MARK = "pav_backdrop"


def show_pictures(camera: Any, folder: Path, frames: np.ndarray) -> None:
    """Shows `folder`/%06d.png behind what the camera object sees, each picture at the scene frame
    of its number; `frames` ascending. Replaces what an earlier call showed, and nothing else.

    Frames without a picture show none. Nothing is shown where the first picture is missing.
    """
    import bpy

    ours = [background for background in camera.data.background_images if _is_ours(background)]
    first, last = int(frames[0]), int(frames[-1])
    path = folder / f"{first:06d}.png"
    if not path.is_file():
        for background in ours:
            camera.data.background_images.remove(background)
        return
    background = ours[0] if ours else camera.data.background_images.new()
    # a background that is taken away leaves its image behind, so the image is used again
    if background.image is None:
        background.image = bpy.data.images.load(str(path.resolve()))
        background.image[_MARK] = True
    image = background.image
    image.name, image.filepath = f"{folder.parent.name} pictures", str(path.resolve())
    image.source = "SEQUENCE"
    # Blender shows file number: scene frame - frame_start + 1 + frame_offset
    user = background.image_user
    user.frame_start, user.frame_offset = first, first - 1
    user.frame_duration = last - first + 1
    user.use_auto_refresh = True
    background.alpha, background.display_depth = 1.0, "BACK"
    background.frame_method = "STRETCH"
    camera.data.show_background_images = True


def pictures_of(camera: Any) -> list[Any]:
    """The images that `show_pictures` has put behind what the camera object sees."""
    return [b.image for b in camera.data.background_images if _is_ours(b)]


def _is_ours(background: Any) -> bool:
    return background.image is not None and bool(background.image.get(_MARK))
