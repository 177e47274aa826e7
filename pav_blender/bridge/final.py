"""The final render (F12, `-a`): what the engine class calls."""

from __future__ import annotations

import os
import sys
import traceback
from typing import Any

import bpy
import numpy as np

from ..core.errors import Cancelled, InputError, PavError
from . import compositing, requirements, reuse, turns
from .render import Pixels
from .reuse import draw
from .shot import Shot, read_shot

_asked: list[str] = []  # the scene whose render was asked for, from start to end


def render(engine: Any, depsgraph: Any) -> None:
    """Renders one view layer into `engine`; every failure is reported, so that a farm stops.

    Only `report({"ERROR"})` with nothing written makes `-a` end with code 1.
    """
    try:
        requirements.check()
        _check_engine(depsgraph.scene_eval.original)
        shot = read_shot(engine, depsgraph)
        _check_size(engine, depsgraph, shot)
        engine.update_stats("", f"PAV: {shot.camera.width}x{shot.camera.height}")
        with turns.first():
            pixels = draw(shot, engine.update_progress, engine.test_break)
    except Cancelled:
        return
    except Exception as error:
        if not isinstance(error, PavError):
            traceback.print_exc()
            error = PavError(f"{type(error).__name__}: {error} (a fault of PAV, see the console)")
        _fail(engine, depsgraph, str(error))
        return
    _write(engine, depsgraph.view_layer_eval, shot, pixels)


def _check_engine(scene: Any) -> None:
    """A scene whose heads another one renders for its compositor must not draw them itself."""
    heads = compositing.head_scene(scene)
    if heads is not None:
        raise InputError(
            f"scene {scene.name!r} is composited with its heads, which {heads.name!r} renders: its "
            "own engine must be Cycles or EEVEE (on a command line leave out `-E PAV`)"
        )


def _check_size(engine: Any, depsgraph: Any, shot: Shot) -> None:
    """A scene nested in another's compositing is asked for a picture of the outer one's size."""
    asked, found = (
        (engine.resolution_x, engine.resolution_y),
        (shot.camera.width, shot.camera.height),
    )
    if asked != found:
        raise InputError(
            f"scene {depsgraph.scene_eval.name!r} renders {found[0]}x{found[1]} pixels and is "
            f"composited into a picture of {asked[0]}x{asked[1]}: give both scenes the same size"
        )


def _write(engine: Any, layer: Any, shot: Shot, pixels: Pixels) -> None:
    x0, y0, x1, y1 = shot.region
    result = engine.begin_result(0, 0, x1 - x0, y1 - y0, layer=layer.name)
    passes = result.layers[0].passes
    for name, picture in (("Combined", pixels.combined), ("Depth", pixels.depth)):
        target = passes.find_by_name(name, "")
        if target is not None:
            flipped = np.ascontiguousarray(picture[::-1], np.float32)  # row 0 at the bottom
            target.rect.foreach_set(flipped.ravel())
    engine.end_result(result)


def _fail(engine: Any, depsgraph: Any, message: str) -> None:
    scene = depsgraph.scene_eval
    where = f"frame {scene.frame_current}: {message}"
    engine.report({"ERROR"}, f"PAV: {where}")
    nested = bool(_asked) and _asked[-1] != scene.name
    if nested and bpy.app.background:
        # Blender would go on, write the outer scene without the avatar and end with code 0
        print(f"Error: PAV: {where} (scene {scene.name!r} inside {_asked[-1]!r})", file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(1)


@bpy.app.handlers.persistent
def _started(scene: Any, *_rest: Any) -> None:
    _asked[:] = [scene.name]


@bpy.app.handlers.persistent
def _ended(*_rest: Any) -> None:
    _asked.clear()


def register() -> None:
    bpy.app.handlers.render_init.append(_started)
    bpy.app.handlers.render_complete.append(_ended)
    bpy.app.handlers.render_cancel.append(_ended)


def unregister() -> None:
    bpy.app.handlers.render_cancel.remove(_ended)
    bpy.app.handlers.render_complete.remove(_ended)
    bpy.app.handlers.render_init.remove(_started)
    _ended()
    reuse.forget()
