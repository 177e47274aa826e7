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
from dataclasses import dataclass, field, replace
from typing import Any

import bpy
import numpy as np

from ..core.errors import Cancelled, PavError
from ..core.rendering.cameras import Camera
from ..core.rendering.solids import Solid
from . import requirements, turns
from .render import Pixels, Posed, draw
from .shot import Actor, Shot, film_background, find_actors
from .sight import view_border, view_camera
from .solids import Copies
from .windows import redraw

_COARSE_S = 0.06  # what the first picture of a new view may take, while the user waits for it
_CHUNK = 2048
_POLL_S = 1 / 30
_PATIENCE_S = 10.0  # for the thread to notice that it is to end
_SHARES = (1 / 8, 1 / 4, 1 / 2, 1)  # of the view's sides
_SAMPLES = (4, 2, 1, 2)  # solids cost little: finer than the avatar, and at last smooth

_waiting: list[weakref.ref[View]] = []  # guarded by turns.changed
_finished = threading.Event()
_drawing = threading.Lock()  # one picture at a time: the renderer uses every core for each
_posed = Posed(kept=4)  # guarded by _drawing; views of one scene share it
_rate = 20_000.0  # pixels a second, as measured
_warm = False  # torch and the kernels are loaded: many seconds the first time, never in front
_thread: threading.Thread | None = None
_stopping = False


@dataclass(frozen=True)
class Outcome:
    """A picture in the share with this number in _SHARES; None, and why, where there is none."""

    pixels: Pixels | None
    message: str
    share: int


@dataclass(eq=False)
class View:
    """The state of one rendered 3D view. `shot` is what it should show, `pixels` what it has,
    `share` the number in _SHARES of the next picture, `seen` what its settings hide."""

    actors: tuple[Actor, ...] = ()
    solids: tuple[Solid, ...] = ()
    background: tuple[float, float, float] | None = None
    shot: Shot | None = None
    pixels: Pixels | None = None
    message: str = ""
    changed: bool = True
    shown: Pixels | None = None
    texture: Any = None
    share: int = 0
    seen: object = None
    copies: Copies = field(default_factory=Copies)

    def update(self, depsgraph: Any, space: Any = None) -> None:
        """Takes a copy of what is to be drawn, as the 3D view `space` shows it. Blender calls this
        for every edit of the file; one that does not concern the picture changes nothing."""
        message = ""
        actors: tuple[Any, ...] = ()
        solids = self.solids
        self.seen = hiding(space)

        def shown(evaluated: Any) -> bool:
            return space is None or evaluated.visible_in_viewport_get(space)

        try:
            requirements.check()
            solids = self.copies.collect(depsgraph, shown)
            actors = find_actors(depsgraph, shown)
            if not actors:
                message = "No avatar in view: choose an avatar file in the PAV tab"
        except Exception as error:
            message = _explained(error)
        background = film_background(depsgraph.scene_eval)
        same_actors = _equal(actors, self.actors)
        told = message == self.message if not actors else not self.message
        if same_actors and told and _equal(solids, self.solids) and background == self.background:
            return
        if not same_actors:
            self.actors = actors
        self.solids, self.background, self.message = solids, background, message
        self.changed = True

    def look(self, camera: Camera) -> None:
        """Brings the picture to the camera: nothing if it has it, else the coarse one now and the
        finer ones later."""
        if not (self.actors or self.solids):
            self.shot = self.pixels = None
            return
        if not self.changed and self.shot is not None and _same(self.shot.camera, camera):
            return
        self.changed = False
        whole = (0, 0, camera.width, camera.height)
        self.shot = Shot(
            self.actors, camera, whole, "preview", self.background, _CHUNK, self.solids
        )
        self.share = 0
        if _warm:
            with turns.first(), _drawing:
                self.take(self.shot, _draw(self.shot, None, lambda: False))
        else:
            self.message = "Loading"
        if self.share < len(_SHARES):
            _ask(weakref.ref(self))

    def take(self, shot: Shot, outcome: Outcome) -> None:
        """Accepts a picture (or what went wrong) if it still shows what it should."""
        if shot is not self.shot:
            return
        if outcome.message or shot.actors:
            self.message = outcome.message
        if outcome.pixels is not None:
            self.pixels, self.share = outcome.pixels, outcome.share + 1
        else:
            self.share = len(_SHARES)  # no finer picture will go better


def _draw(shot: Shot, share: int | None, should_stop: Callable[[], bool]) -> Outcome:
    """A share of a shot's pixels, or what went wrong; None: the finest share that is ready soon
    enough to be waited for. Cancelled where `should_stop` said so."""
    global _rate, _warm
    begun = time.perf_counter()
    try:
        for actor in shot.actors:
            _posed.scene(actor)  # kept: what follows costs by the pixel
        posed = time.perf_counter()
        if share is None:
            share = _coarsest(shot.camera, _COARSE_S - (posed - begun))
        pixels = draw(_shared(shot, share), should_stop=should_stop, posed=_posed)
    except Cancelled:
        raise
    except Exception as error:
        return Outcome(None, _explained(error), share or 0)
    if _warm:
        _rate = pixels.display[..., 0].size / max(time.perf_counter() - posed, 1e-4)
    _warm = True
    return Outcome(pixels, "", share)


def _shared(shot: Shot, share: int) -> Shot:
    """The shot with a share of its pixels."""
    width, height = (max(1, round(n * _SHARES[share])) for n in shot.region[2:])
    samples = _SAMPLES[share] if shot.solids else 1
    return replace(
        shot,
        camera=shot.camera.resized(width, height),
        region=(0, 0, width, height),
        samples=samples,
        enlarged=_SHARES[share] < 1,
    )


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
            outcome = _draw(
                shot, share, lambda: _stopping or turns.wanted() or not _current(owner, shot)
            )
    except Cancelled:
        if _current(owner, shot):
            _ask(owner)
        return False
    view = owner()
    if view is not None:
        view.take(shot, outcome)
    return view is not None


def _current(owner: weakref.ref[View], shot: Shot) -> bool:
    view = owner()
    return view is not None and view.shot is shot


def draw_view(engine: Any, view: View, context: Any, depsgraph: Any) -> None:
    """Called inside Blender's drawing: puts the newest picture into the 3D view."""
    region, region_data, space = context.region, context.region_data, context.space_data
    scene = depsgraph.scene_eval
    if not bpy.app.timers.is_registered(_poll):
        bpy.app.timers.register(_poll, persistent=True)
    if view.seen != hiding(space):  # Blender tells nobody that something is shown alone now
        view.update(depsgraph, space)
    x0, y0, x1, y1 = view_border(region, region_data, space, scene)
    if x0 == x1:
        return
    try:
        view.look(view_camera(region, region_data).window(x0, y0, x1, y1))
    except PavError as error:
        view.message, view.pixels = str(error), None
    engine.update_stats("PAV", view.message)
    if view.pixels is not None:
        _show(engine, view, view.pixels, scene, (x0, region.height - y1, x1 - x0, y1 - y0))


def hiding(space: Any) -> object:
    """What of a 3D view's settings decides which objects it shows."""
    if space is None:
        return None
    return (
        space.local_view is not None,
        space.use_local_collections,
        space.show_object_viewport_mesh,
    )


def _show(
    engine: Any, view: View, pixels: Pixels, scene: Any, place: tuple[int, int, int, int]
) -> None:
    import gpu
    from gpu_extras.presets import draw_texture_2d

    x, y, across, up = place
    if pixels is not view.shown:
        height, width = pixels.depth.shape
        flat = np.ascontiguousarray(pixels.combined[::-1], np.float32).ravel()
        buffer = gpu.types.Buffer("FLOAT", len(flat), flat)
        view.texture = gpu.types.GPUTexture((width, height), format="RGBA16F", data=buffer)
        view.shown = pixels
    gpu.state.blend_set("ALPHA_PREMULT")
    engine.bind_display_space_shader(scene)
    draw_texture_2d(view.texture, (x, y), across, up)
    engine.unbind_display_space_shader()
    gpu.state.blend_set("NONE")


def _coarsest(camera: Camera, seconds: float) -> int:
    """The finest picture that takes no longer; the coarsest where none does."""
    affordable = _rate * seconds
    fitting = [
        i for i, part in enumerate(_SHARES) if camera.width * camera.height * part**2 <= affordable
    ]
    return fitting[-1] if fitting else 0


def _explained(error: Exception) -> str:
    return str(error) or type(error).__name__


def _equal(some: tuple[Any, ...], others: tuple[Any, ...]) -> bool:
    return len(some) == len(others) and all(
        one.equals(other) for one, other in zip(some, others, strict=True)
    )


def _same(one: Camera, other: Camera) -> bool:
    return (
        (one.width, one.height, one.parallel) == (other.width, other.height, other.parallel)
        and np.allclose(one.intrinsics, other.intrinsics, atol=1e-4)
        and np.allclose(one.camera_to_world, other.camera_to_world, atol=1e-7)
    )


def _ask(owner: weakref.ref[View]) -> None:
    global _thread
    with turns.changed:
        if _stopping:
            return
        if owner not in _waiting:
            _waiting.append(owner)
        turns.changed.notify_all()
        if _thread is None:
            _thread = threading.Thread(target=_work, name="pav viewport", daemon=True)
            _thread.start()


def _work() -> None:
    while True:
        with turns.changed:
            while not _stopping and (not _waiting or turns.wanted()):
                turns.changed.wait()
            if _stopping:
                return
            owner = _waiting.pop(0)
        refine(owner)


def _poll() -> float:
    if _finished.is_set():
        _finished.clear()
        redraw("VIEW_3D")
    return _POLL_S


def register() -> None:
    global _stopping
    _stopping = False


def unregister() -> None:
    """The thread ends before its code goes; Blender unregisters add-ons when it quits, too."""
    global _stopping, _thread
    if bpy.app.timers.is_registered(_poll):
        bpy.app.timers.unregister(_poll)
    with turns.changed:
        _stopping = True
        _waiting.clear()
        turns.changed.notify_all()
    if _thread is not None:
        _thread.join(_PATIENCE_S)
        _thread = None
    _posed.forget()
