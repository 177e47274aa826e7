"""The colour management under which an avatar's colours reach a screen as they were learned."""

from __future__ import annotations

from typing import Any


def is_standard(scene: Any) -> bool:
    """Whether a scene shows what was trained: display sRGB, view Standard and nothing on top."""
    view = scene.view_settings
    return (
        scene.display_settings.display_device == "sRGB"
        and (view.view_transform, view.look) == ("Standard", "None")
        and (view.exposure, view.gamma, view.use_curve_mapping) == (0.0, 1.0, False)
    )


def use_standard(scene: Any) -> None:
    scene.display_settings.display_device = "sRGB"
    view = scene.view_settings
    view.view_transform, view.look = "Standard", "None"
    view.exposure, view.gamma, view.use_curve_mapping = 0.0, 1.0, False
