"""Run inside Blender's window: a training runs, and the Training panel shows how it is going.

    blender --python tools/show_training.py -- out/demo/collection out/shown.pav 3

trains for 3 minutes, or goes on where such a training was cut off. For the picture of the real
window in docs/: photograph it meanwhile.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy

_TRIES = 60
_tried = 0


def show() -> float | None:
    """Sets up the window; a timer's, for a sidebar's tab can be chosen only once it was drawn."""
    global _tried
    _tried += 1
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                show_view(area)
    if _tried == 4:
        begin()
    return 0.5 if _tried < _TRIES else None


def show_view(area) -> None:
    space = area.spaces.active
    space.show_region_ui = True
    for region in area.regions:
        if region.type == "UI" and region.active_panel_category != "PAV":
            try:
                region.active_panel_category = "PAV"
            except (AttributeError, TypeError):
                continue  # not drawn yet


def begin() -> None:
    """A head to look at, and the training that the command line asks for."""
    collection, output, minutes = sys.argv[sys.argv.index("--") + 1 :]
    for thing in list(bpy.context.scene.objects):
        bpy.data.objects.remove(thing)
    bpy.ops.pav.add_rig()
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                look_at_head(window, area)
    settings = bpy.context.scene.pav.training
    unfinished = Path(f"{output}.job.json").exists()
    settings.source = "COLLECTION"
    settings.collection = str(Path(collection).resolve())
    settings.output = str(Path(output).resolve())
    settings.minutes = float(minutes)
    if unfinished:
        bpy.ops.pav.resume_training()
    else:
        bpy.ops.pav.train()


def look_at_head(window, area) -> None:
    region = next(region for region in area.regions if region.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.view3d.view_axis(type="FRONT")
        bpy.ops.view3d.view_selected()
        bpy.ops.view3d.view_orbit(angle=0.5, type="ORBITLEFT")


def close_others() -> None:
    """The other panels begin closed, so that the one shown has room."""
    for name in ("PAV_PT_avatar", "PAV_PT_track", "PAV_PT_frames"):
        panel = getattr(bpy.types, name, None)
        if panel is not None:
            bpy.utils.unregister_class(panel)
            panel.bl_options = {"DEFAULT_CLOSED"}
            bpy.utils.register_class(panel)


bpy.context.preferences.view.show_splash = False
close_others()
bpy.app.timers.register(show, first_interval=0.5)
