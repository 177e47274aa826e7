"""Blender's windows as timers and panels use them: redrawing, and pictures as icons."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np


def show_as_icon(preview: Any, picture: np.ndarray, *, small: bool = True) -> None:
    """Gives a preview of `bpy.utils.previews` a picture [H, W, 4], straight, in [0, 1], row 0 on
    top. small: also where Blender shows it beside text."""
    shown = np.array(picture[::-1], np.float32)
    shown[..., :3] *= shown[..., 3:]  # icons are premultiplied
    for kind in ("image", "icon") if small else ("image",):
        setattr(preview, f"{kind}_size", picture.shape[1::-1])
        getattr(preview, f"{kind}_pixels_float").foreach_set(shown.ravel())


def redraw(*kinds: str) -> None:
    """Asks every open area of these kinds ("VIEW_3D", ...) to be drawn again."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in kinds:
                area.tag_redraw()
