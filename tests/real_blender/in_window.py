"""Run inside Blender's window by `test_window.py`: a user in a hurry, while the 3D view computes.

    blender walk.blend --python in_window.py -- ANSWER.json SECONDS

Every step gives Blender time to draw by yielding seconds. What was seen is written to ANSWER.json;
then Blender quits.
"""

from __future__ import annotations

import json
import sys
import time
import traceback
import weakref
from pathlib import Path

import addon_utils
import bpy
import numpy as np
from mathutils import Quaternion

PACKAGE = "bl_ext.user_default.pav_blender"
ANSWER, LIMIT = Path(sys.argv[sys.argv.index("--") + 1]), float(sys.argv[-1])
seen: dict[str, object] = {"drawn": 0, "widths": [], "messages": []}
known: weakref.WeakSet = weakref.WeakSet()  # every View that was drawn and is still there
begun = time.monotonic()


def began():
    global begun
    begun = time.monotonic()


def viewport():
    return sys.modules[f"{PACKAGE}.bridge.viewport"]


def watch():
    """Counts what the engine draws, and how fine."""
    engine = sys.modules[f"{PACKAGE}.engine"].PavRenderEngine
    real = engine.view_draw

    def view_draw(self, context, depsgraph):
        real(self, context, depsgraph)
        seen["drawn"] += 1
        if self.view is not None:
            known.add(self.view)
        if self.view is not None and self.view.pixels is not None:
            seen["widths"].append(self.view.pixels.display.shape[1])
            if self.view.message not in seen["messages"]:
                seen["messages"].append(self.view.message)

    engine.view_draw = view_draw


def areas():
    screen = bpy.context.window_manager.windows[0].screen
    return [area for area in screen.areas if area.type == "VIEW_3D"]


def main_region(area):
    return next(region for region in area.regions if region.type == "WINDOW")


def call(operator, area, **arguments):
    window = bpy.context.window_manager.windows[0]
    with bpy.context.temp_override(window=window, area=area, region=main_region(area)):
        return operator(**arguments)


def shade(kind):
    for area in areas():
        area.spaces.active.shading.type = kind
        area.tag_redraw()


def views():
    return list(known)


def finest():
    """Waits until some view has its finest picture, and returns that view."""
    while True:
        for view in views():
            if view.shot is not None and view.share == len(viewport()._SHARES):
                return view
        yield 0.05


def story():
    yield 1.0
    bpy.context.preferences.view.show_splash = False
    watch()
    shade("RENDERED")
    areas()[0].spaces.active.region_3d.view_perspective = "CAMERA"
    yield from finest()  # on a new machine the kernels are compiled first
    began()
    seen["first message"] = views()[0].message
    yield from registered()
    yield from solids()
    before = seen["drawn"]
    for i in range(200):
        shade("SOLID" if i % 2 == 0 else "RENDERED")
        yield 0.01 + 0.03 * (i % 3)
    seen["drawn while switching"] = seen["drawn"] - before
    scene = bpy.context.scene
    for i in range(30):
        scene.frame_set(scene.frame_start + i % 4)
        yield 0.02
    data = areas()[0].spaces.active.region_3d
    data.view_perspective = "PERSP"
    for i in range(30):
        data.view_perspective = "ORTHO" if i % 10 == 9 else "PERSP"
        data.view_rotation = Quaternion((0, 0, 1), 0.1 * i) @ Quaternion((1, 0, 0), 1.4)
        data.view_location, data.view_distance = (0, 0, 0), 0.8
        yield 0.02
    yield from finest()
    yield from layouts()
    yield from files()
    seen["crossed"] = [round(w) for w in sorted(set(seen["widths"]))]
    seen["ok"] = True


def registered():
    """The camera's view at one pixel to a pixel of the final picture, against that picture."""
    scene, area = bpy.context.scene, areas()[0]
    scene.render.resolution_x, scene.render.resolution_y = 300, 240
    scene.render.film_transparent = True
    scene.pav.quality = "PREVIEW"
    space, region = area.spaces.active, main_region(area)
    space.overlay.show_overlays = False
    yield 0.2
    call(bpy.ops.view3d.zoom_camera_1_to_1, area)
    space.region_3d.view_camera_offset = 0.031, -0.017
    area.tag_redraw()
    yield 0.3
    view = yield from finest()
    sight = sys.modules[f"{PACKAGE}.bridge.sight"]
    left, low, right, high = sight._camera_frame(region, space.region_3d, space.camera, scene)
    ours = view.pixels.combined[::-1, :, 3] > 0.5
    bpy.ops.render.render()
    path = ANSWER.with_suffix(".exr")
    scene.render.image_settings.file_format = "OPEN_EXR"
    bpy.data.images["Render Result"].save_render(str(path.resolve()))
    final = bpy.data.images.load(str(path.resolve()))
    width, height = final.size
    alpha = np.array(final.pixels[:]).reshape(height, width, -1)[..., 3] > 0.5
    x, y = round(left), round(low)
    part = ours[y : y + height, x : x + width]
    thick = np.zeros_like(part)  # all that is a pixel at most from an edge
    for shift in (-1, 0, 1):
        for axis in (0, 1):
            thick |= np.roll(part, shift, axis) != part
    seen["scale"] = [(right - left) / width, (high - low) / height]
    seen["silhouette"] = int(alpha.sum())
    seen["edge"] = int(thick.sum())
    seen["off by more than a pixel"] = int(((part != alpha) & ~thick).sum())
    seen["off"] = int((part != alpha).sum())
    scene.render.use_border = True
    scene.render.border_min_x, scene.render.border_max_x = 0.25, 0.75
    scene.render.border_min_y, scene.render.border_max_y = 0.25, 0.75
    yield 0.3
    view = yield from finest()
    shape = view.pixels.display.shape
    seen["border"] = [shape[1] / width, shape[0] / height]
    scene.render.use_border = False


def solids():
    """A cube comes, moves, is bent and shown alone; the picture follows."""
    area = areas()[0]
    bpy.ops.mesh.primitive_cube_add(size=0.1, location=(0.05, -0.1, 0))
    cube, states = bpy.context.object, []

    def state():
        yield 0.3
        view = yield from finest()
        states.append(view.solids)

    yield from state()
    cube.location.x = 0.1
    yield from state()
    cube.data.vertices[0].co.x = -0.3
    cube.data.update()
    yield from state()
    call(bpy.ops.object.mode_set, area, mode="EDIT")
    yield from state()
    call(bpy.ops.object.mode_set, area, mode="OBJECT")
    head = next(thing for thing in bpy.context.scene.objects if thing.pav.avatar)
    cube.select_set(False)
    head.select_set(True)
    call(bpy.ops.view3d.localview, area)
    yield 0.5
    alone = yield from finest()
    seen["alone"] = [len(alone.actors), len(alone.solids)]
    call(bpy.ops.view3d.localview, area)
    yield from state()
    seen["solids"] = [len(solids) for solids in states]
    seen["bent"] = states[1][0].shape is not states[2][0].shape
    seen["moved"] = not np.array_equal(states[0][0].place, states[1][0].place)


def layouts():
    """Two views at once, four in one, and a view that goes while it computes."""
    area = areas()[0]
    call(bpy.ops.screen.area_split, area, direction="VERTICAL", factor=0.4)
    yield 0.1
    shade("RENDERED")
    yield 0.5
    seen["views at once"] = len(views())
    other = areas()[-1]
    other.spaces.active.region_3d.view_rotation = Quaternion((0.7, 0.7, 0, 0))
    yield 0.05
    call(bpy.ops.screen.area_close, other)
    yield 0.3
    call(bpy.ops.screen.region_quadview, areas()[0])
    yield 0.5
    seen["views of four"] = len(views())
    call(bpy.ops.screen.region_quadview, areas()[0])
    yield 0.1
    call(bpy.ops.screen.screen_full_area, areas()[0])
    yield 0.3
    bpy.ops.screen.back_to_previous()
    yield 0.3


def files():
    """Another file, no file, and no add-on, each while the view computes."""
    path = bpy.data.filepath
    for _ in range(3):
        bpy.ops.wm.open_mainfile(filepath=path)
        yield 0.3
        shade("RENDERED")
        yield 0.1
    bpy.ops.wm.read_homefile(use_factory_startup=False)
    yield 0.2
    bpy.ops.wm.open_mainfile(filepath=path)
    yield 0.3
    shade("RENDERED")
    yield 0.05
    addon_utils.disable(PACKAGE)
    yield 0.3
    addon_utils.enable(PACKAGE)
    yield 0.1
    watch()
    shade("SOLID")
    yield 0.1
    bpy.context.scene.render.engine = "PAV"
    shade("RENDERED")
    yield from finest()
    areas()[0].spaces.active.region_3d.view_perspective = "PERSP"
    yield 0.02  # and Blender quits while it computes


telling = story()


def step():
    try:
        if time.monotonic() - begun > LIMIT:
            telling.throw(TimeoutError(f"not over after {LIMIT} s"))
        return next(telling)
    except StopIteration:
        pass
    except BaseException:
        seen["error"] = traceback.format_exc()
    ANSWER.write_text(json.dumps(seen))
    bpy.ops.wm.quit_blender()
    return None


bpy.app.timers.register(step, first_interval=0.5, persistent=True)
