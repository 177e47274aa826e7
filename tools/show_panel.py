"""Run inside Blender's window: the PAV tab open, the camera's view, Rendered shading.

    blender out/demo/avatar.blend --python tools/show_panel.py -- [--appearance NAME] [--layers]
        [--bare]

For pictures of the real window in docs/ (`tools/photographs.sh` takes them all). --layers: hair and
beard of other appearances; --bare: the 3D view alone, without sidebar. The sidebar's tab can be
chosen only once it was drawn, so this tries again for a while.
"""

from __future__ import annotations

import argparse
import sys

import bpy

_TRIES = 40
_tried = 0


def show() -> float | None:
    """Sets up every 3D view; called by a timer until it has had its tries."""
    global _tried
    _tried += 1
    bpy.context.preferences.view.show_splash = False
    heads = [thing for thing in bpy.context.scene.objects if thing.pav.avatar]
    if heads:
        bpy.context.view_layer.objects.active = heads[0]
        if _tried == 1:
            dress(heads[0])
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                show_view(area)
            elif area.type == "PROPERTIES":
                area.spaces.active.context = "RENDER"
    return 0.5 if _tried < _TRIES else None


def dress(head) -> None:
    """What the command line asks for."""
    if _asked.appearance:
        head.pav.appearance = _asked.appearance
    if _asked.layers:
        for area in ("BEARD", "HAIR"):
            bpy.ops.pav.add_layer(area=area)


def show_view(area) -> None:
    """One 3D view: sidebar, camera, shading."""
    space = area.spaces.active
    space.show_region_ui = not _asked.bare
    space.show_region_toolbar = not _asked.bare
    space.overlay.show_overlays = False
    space.show_gizmo = not _asked.bare
    space.region_3d.view_perspective = "CAMERA"
    space.shading.type = "RENDERED"
    for region in area.regions:
        if region.type == "UI" and region.active_panel_category != "PAV":
            try:
                region.active_panel_category = "PAV"
            except (AttributeError, TypeError):
                continue  # not drawn yet
    area.tag_redraw()


_parser = argparse.ArgumentParser()
_parser.add_argument("--appearance")
_parser.add_argument("--layers", action="store_true")
_parser.add_argument("--bare", action="store_true")
_asked = _parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])
bpy.app.timers.register(show, first_interval=0.5)
