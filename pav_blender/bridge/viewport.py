"""The rendered 3D view: a coarse picture at once, finer ones from a thread.

Blender's data is copied when it changes; the thread sees copies only and never touches the engine,
which Blender frees without notice. It leaves its picture and raises a flag that a timer turns into
a redraw.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import bpy
import numpy as np

from ..core.errors import Cancelled, PavError
from ..core.rendering.cameras import Camera
from . import requirements, turns
from .axes import camera_to_core
from .lens import from_projection
from .render import Pixels, draw
from .shot import Actor, Shot, film_background, find_actors

ORTHO_DISTANCE = 50.0  # metres; from there a perspective view is as good as a parallel one
_COARSE_S = 0.06  # what the first picture of a new view may take, while the user waits for it
_CHUNK = 2048
_POLL_S = 1 / 30
_SHARES = (1 / 8, 1 / 4, 1 / 2, 1)  # of the view's sides

_waiting: list[weakref.ref[View]] = []  # guarded by turns.changed
_finished = threading.Event()
_drawing = threading.Lock()  # one picture at a time: the renderer uses every core for each
_rate = 20_000.0  # pixels a second, as measured
_warm = False  # torch and the kernels are loaded: many seconds the first time, never in front
_thread: threading.Thread | None = None


@dataclass(eq=False)
class View:
    """The state of one rendered 3D view. `shot` is what it should show, `pixels` what it has,
    `share` the number in _SHARES of the next picture."""

    actors: tuple[Actor, ...] = ()
    background: tuple[float, float, float] | None = None
    shot: Shot | None = None
    pixels: Pixels | None = None
    message: str = ""
    changed: bool = True
    shown: Pixels | None = None
    texture: Any = None
    share: int = 0

    def update(self, depsgraph: Any) -> None:
        """Takes a copy of what is to be drawn. Blender calls this for every edit of the file; one
        that does not concern the picture changes nothing."""
        message = ""
        actors: tuple[Any, ...] = ()
        try:
            requirements.check()
            actors = find_actors(depsgraph)
            if not actors:
                message = "No avatar in view: choose an avatar file in the PAV tab"
        except PavError as error:
            message = str(error)
        background = film_background(depsgraph.scene_eval)
        alike = len(actors) == len(self.actors) and all(
            one.equals(other) for one, other in zip(actors, self.actors, strict=True)
        )
        if alike and background == self.background and not (message or self.message):
            return
        self.actors, self.background, self.message = actors, background, message
        self.changed = True

    def look(self, camera: Camera) -> None:
        """Brings the picture to the camera: nothing if it has it, else the coarse one now and the
        finer ones later."""
        if not self.actors:
            self.shot = self.pixels = None
            return
        if not self.changed and self.shot is not None and _same(self.shot.camera, camera):
            return
        self.changed = False
        whole = (0, 0, camera.width, camera.height)
        self.shot = Shot(self.actors, camera, whole, "preview", self.background, _CHUNK)
        self.share = 0
        if _warm:
            self.share = _coarsest(camera)
            with turns.first(), _drawing:
                self.take(self.shot, *_draw(self.shot, self.share, lambda: False))
        else:
            self.message = "Loading"
        if self.share < len(_SHARES):
            _ask(weakref.ref(self))

    def take(self, shot: Shot, pixels: Pixels | None, message: str) -> None:
        """Accepts a picture (or what went wrong) if it still shows what it should."""
        if shot is not self.shot:
            return
        self.message = message
        if pixels is not None:
            self.pixels = pixels
            self.share += 1
        else:
            self.share = len(_SHARES)  # no finer picture will go better


def _draw(shot: Shot, share: int, should_stop: Callable[[], bool]) -> tuple[Pixels | None, str]:
    """A share of a shot's pixels, or what went wrong. Cancelled where `should_stop` said so."""
    global _rate, _warm
    part = _SHARES[share]
    camera = shot.camera.resized(
        max(1, round(shot.camera.width * part)), max(1, round(shot.camera.height * part))
    )
    region = (0, 0, camera.width, camera.height)
    begun = time.perf_counter()
    try:
        pixels = draw(replace(shot, camera=camera, region=region), should_stop=should_stop)
    except Cancelled:
        raise
    except Exception as error:
        return None, str(error) or type(error).__name__
    if _warm:
        _rate = camera.width * camera.height / max(time.perf_counter() - begun, 1e-4)
    _warm = True
    return pixels, ""


def refine(owner: weakref.ref[View]) -> None:
    """On the thread: the next finer picture of a view, and so on until it changes or is closed.

    Only a weak reference is held: Blender drops the engine, and with it the view, at every switch
    of shading. What goes before interrupts; the picture is then asked for again.
    """
    while _refine_once(owner):
        _finished.set()


def _refine_once(owner: weakref.ref[View]) -> bool:
    view = owner()
    if view is None or view.shot is None or view.share >= len(_SHARES):
        return False
    shot, share = view.shot, view.share
    del view
    try:
        with _drawing:
            outcome = _draw(shot, share, lambda: turns.wanted() or not _current(owner, shot))
    except Cancelled:
        if _current(owner, shot):
            _ask(owner)
        return False
    view = owner()
    if view is not None:
        view.take(shot, *outcome)
    return view is not None


def _current(owner: weakref.ref[View], shot: Shot) -> bool:
    view = owner()
    return view is not None and view.shot is shot


def view_camera(region: Any, region_data: Any) -> Camera:
    """The camera of a 3D view in core axes; a parallel view is seen from far away."""
    matrix = np.array(region_data.view_matrix.inverted())
    projection = np.array(region_data.window_matrix)
    width, height = region.width, region.height
    if region_data.is_perspective or abs(projection[3, 2] + 1) < 1e-6:
        intrinsics = from_projection(projection, width, height)
        return Camera(width, height, intrinsics, camera_to_core(matrix))
    intrinsics = np.array(
        [
            [projection[0, 0] * width / 2 * ORTHO_DISTANCE, 0, (1 + projection[0, 3]) * width / 2],
            [
                0,
                projection[1, 1] * height / 2 * ORTHO_DISTANCE,
                (1 - projection[1, 3]) * height / 2,
            ],
            [0, 0, 1],
        ]
    )
    focus = np.array(region_data.view_location)
    back = matrix[:3, 2]
    # the plane through the point that the view turns about keeps its size
    matrix[:3, 3] += back * (ORTHO_DISTANCE - back @ (matrix[:3, 3] - focus))
    return Camera(width, height, intrinsics, camera_to_core(matrix))


def draw_view(engine: Any, view: View, context: Any, scene: Any) -> None:
    """Called inside Blender's drawing: puts the newest picture into the 3D view."""
    import gpu
    from gpu_extras.presets import draw_texture_2d

    view.look(view_camera(context.region, context.region_data))
    if not bpy.app.timers.is_registered(_poll):
        bpy.app.timers.register(_poll, persistent=True)
    engine.update_stats("PAV", view.message)
    pixels = view.pixels
    if pixels is None:
        return
    if pixels is not view.shown:
        height, width = pixels.depth.shape
        flat = np.ascontiguousarray(pixels.combined[::-1], np.float32).ravel()
        buffer = gpu.types.Buffer("FLOAT", len(flat), flat)
        view.texture = gpu.types.GPUTexture((width, height), format="RGBA16F", data=buffer)
        view.shown = pixels
    gpu.state.blend_set("ALPHA_PREMULT")
    engine.bind_display_space_shader(scene)
    draw_texture_2d(view.texture, (0, 0), context.region.width, context.region.height)
    engine.unbind_display_space_shader()
    gpu.state.blend_set("NONE")


def _coarsest(camera: Camera) -> int:
    """The finest picture that is ready soon enough to be waited for."""
    affordable = _rate * _COARSE_S
    fitting = [
        i for i, part in enumerate(_SHARES) if camera.width * camera.height * part**2 <= affordable
    ]
    return fitting[-1] if fitting else 0


def _same(one: Camera, other: Camera) -> bool:
    return (
        (one.width, one.height) == (other.width, other.height)
        and np.allclose(one.intrinsics, other.intrinsics, atol=1e-4)
        and np.allclose(one.camera_to_world, other.camera_to_world, atol=1e-7)
    )


def _ask(owner: weakref.ref[View]) -> None:
    global _thread
    with turns.changed:
        if owner not in _waiting:
            _waiting.append(owner)
        turns.changed.notify_all()
    if _thread is None:
        _thread = threading.Thread(target=_work, daemon=True)
        _thread.start()


def _work() -> None:
    while True:
        with turns.changed:
            while not _waiting or turns.wanted():
                turns.changed.wait()
            owner = _waiting.pop(0)
        refine(owner)


def _poll() -> float:
    if _finished.is_set():
        _finished.clear()
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                if area.type == "VIEW_3D":
                    area.tag_redraw()
    return _POLL_S


def unregister() -> None:
    if bpy.app.timers.is_registered(_poll):
        bpy.app.timers.unregister(_poll)
    with turns.changed:
        _waiting.clear()
