"""Run inside Blender's window: the head among solids, in Rendered shading, filling the window.

    blender out/demo/avatar.blend --python tools/show_viewport.py

For pictures of the real window in docs/: a cube that is half in the head, a ball before it, a wall
behind it, and a floor, with the floor's grid, the cube's outline and the light drawn over them by
Blender itself, so that what is off shows.
"""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Quaternion, Vector

_TRIES = 20
_tried = 0


def furnish() -> Vector:
    """Adds the solids; returns the middle of the head."""
    head = next(thing for thing in bpy.context.scene.objects if thing.pav.avatar)
    evaluated = head.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = np.array([evaluated.matrix_world @ v.co for v in evaluated.data.vertices])
    low, high = points.min(0), points.max(0)
    middle = Vector((0.5 * (low[0] + high[0]), float(np.median(points[:, 1])), high[2] - 0.12))
    operators = bpy.ops.mesh
    operators.primitive_plane_add(size=3, location=(middle.x, middle.y, low[2] + 0.08))
    paint((0.35, 0.37, 0.4))
    operators.primitive_plane_add(size=3, location=(middle.x, middle.y + 0.6, low[2] + 1))
    bpy.context.object.rotation_euler = 1.5708, 0, 0
    paint((0.25, 0.4, 0.5))
    operators.primitive_uv_sphere_add(radius=0.035, location=middle + Vector((-0.09, -0.2, -0.1)))
    bpy.ops.object.shade_smooth()
    paint((0.75, 0.6, 0.1))
    operators.primitive_cube_add(size=0.15, location=middle + Vector((0.085, -0.03, 0.03)))
    bpy.context.object.rotation_euler = 0.3, 0.2, 0.5
    paint((0.65, 0.1, 0.07))
    return middle


def paint(colour: tuple[float, float, float]) -> None:
    """Gives the active object a material of that viewport colour."""
    material = bpy.data.materials.new("solid")
    material.diffuse_color = (*colour, 1.0)
    bpy.context.object.data.materials.append(material)


def show() -> float | None:
    """Sets up the first 3D view; called by a timer until Blender has drawn it a few times."""
    global _tried, _middle
    _tried += 1
    bpy.context.preferences.view.show_splash = False
    scene = bpy.context.scene
    if _tried == 1:
        _middle = furnish()
        scene.render.film_transparent = False
        scene.view_settings.view_transform = "Standard"
    for area in bpy.context.window_manager.windows[0].screen.areas:
        if area.type == "VIEW_3D":
            space = area.spaces.active
            space.show_region_ui = space.show_region_toolbar = False
            space.shading.type = "RENDERED"
            sight = space.region_3d
            sight.view_perspective = "PERSP"
            sight.view_rotation = Quaternion((0, 0, 1), 0.35) @ Quaternion((1, 0, 0), 1.4)
            sight.view_location, sight.view_distance = _middle, 0.9
            area.tag_redraw()
    return 0.5 if _tried < _TRIES else None


_middle = Vector()
bpy.app.timers.register(show, first_interval=0.5)
