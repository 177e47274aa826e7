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

    remove_pictures(camera)
    first, last = int(frames[0]), int(frames[-1])
    path = folder / f"{first:06d}.png"
    if not path.is_file():
        return
    image = bpy.data.images.load(str(path.resolve()))
    image.name, image[_MARK] = f"{folder.parent.name} pictures", True
    image.source = "SEQUENCE"
    background = camera.data.background_images.new()
    background.image = image
    # Blender shows file number: scene frame - frame_start + 1 + frame_offset
    user = background.image_user
    user.frame_start, user.frame_offset = first, first - 1
    user.frame_duration = last - first + 1
    user.use_auto_refresh = True
    background.alpha, background.display_depth = 1.0, "BACK"
    background.frame_method = "STRETCH"
    camera.data.show_background_images = True


def remove_pictures(camera: Any) -> None:
    """Takes away what `show_pictures` has put there."""
    import bpy

    for background in list(camera.data.background_images):
        image = background.image
        if image is not None and image.get(_MARK):
            camera.data.background_images.remove(background)
            if image.users == 0:
                bpy.data.images.remove(image)


def pictures_of(camera: Any) -> list[Any]:
    """The images that `show_pictures` has put before the camera object."""
    images = [background.image for background in camera.data.background_images]
    return [image for image in images if image is not None and image.get(_MARK)]
