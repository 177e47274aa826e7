"""The rendered 3D view: how long one waits for the first picture, and for the finest."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..core.errors import InputError, PavError
from ..core.evaluation.report import Claim
from ..core.progress import Report
from .measure import Options, plot, show, subject

_SIZE = (960, 540)
_MOVES = 24  # of the camera, or frames
_MANY = 500  # faces along either side of a grid of 250,000 quads: 500,000 triangles
_PATIENCE_S = 300.0  # the first time the kernels are compiled


def run(options: Options, progress: Report | None = None) -> tuple[dict[str, Any], list[Claim]]:
    """Drives `bridge.viewport.View` as Blender does, without a window: what a graphics card does
    after it (sending the picture, drawing it) is not in the figures."""
    try:
        import bpy
    except ImportError as error:
        raise InputError("`pav bench viewport` needs Blender, or `pip install bpy`") from error
    _, collection = subject(options, progress)
    from ..bridge.scene import blender, build_scene

    with blender():
        build_scene(options.out / "subject.pav", collection, collection.clips[0].name)
        rows = _measured(bpy)
        _add_grid(bpy)
        crowded = _measured(bpy)
        solids = _rasterised()
    for name, found in (("the head alone", rows), ("with 500,000 triangles beside it", crowded)):
        print(name)
        show(found)
    print(f"100,000 triangles on {_SIZE[0]} x {_SIZE[1]} pixels: {solids:.1f} ms")
    plot(
        options.out / "viewport.svg",
        lambda axes: axes.barh([r["what"] for r in rows], [r["median ms"] for r in rows]),
        f"Until the first picture, {_SIZE[0]} x {_SIZE[1]} pixels",
        "milliseconds",
        "",
    )
    alone = {row["what"]: row["median ms"] for row in rows}
    many = {row["what"]: row["median ms"] for row in crowded}
    claims = [
        Claim.at_most("orbit: first picture", alone["orbit"], 60, "ms"),
        Claim.at_most("scrub: first picture", alone["scrub"], 120, "ms"),
        Claim.at_most("orbit, 500,000 triangles: first picture", many["orbit"], 120, "ms"),
        Claim.at_most("scrub, 500,000 triangles: first picture", many["scrub"], 180, "ms"),
        Claim.at_most("switched to Rendered: first picture", alone["switch"], 150, "ms"),
        Claim.at_most("until the finest picture", alone["until the finest"], 2500, "ms"),
        Claim.at_most("100,000 triangles as solids", solids, 15, "ms"),
    ]
    return {"alone": rows, "crowded": crowded, "solids_ms": round(solids, 2)}, claims


def _measured(bpy: Any) -> list[dict[str, Any]]:
    """Milliseconds of each way to a first picture."""
    from ..bridge import viewport
    from ..bridge.sight import view_camera

    scene = bpy.context.scene

    def updated() -> Any:
        return bpy.context.evaluated_depsgraph_get()

    def camera(turn: float) -> Any:
        return view_camera(*_sight(scene.camera, updated(), turn))

    view = viewport.View()
    view.update(updated())
    view.look(camera(0))
    _wait(lambda: viewport._warm, view)

    def orbit(i: int) -> None:
        view.look(camera(0.05 * (i + 1)))

    def orbit_anew(i: int) -> None:
        viewport._posed.forget()
        view.look(camera(-0.05 * (i + 1)))

    def scrub(i: int) -> None:
        scene.frame_set(scene.frame_start + i)
        view.update(updated())
        view.look(camera(0))

    def switch(i: int) -> None:
        nonlocal view
        view = viewport.View()
        view.update(updated())
        view.look(camera(0.05 * (i % 2)))

    def finest(i: int) -> None:
        view.look(camera(0.2 + 0.05 * i))
        _wait(lambda: view.share == len(viewport._SHARES), view)

    rows = []
    moves = (
        ("orbit", orbit, _MOVES),
        ("orbit, posed anew", orbit_anew, _MOVES),
        ("scrub", scrub, _MOVES),
        ("switch", switch, _MOVES),
        ("until the finest", finest, 3),
    )
    for name, move, count in moves:
        with _alone(viewport) if name != "until the finest" else _together():
            rows.append(_timed(name, move, count, lambda: view))
    return rows


def _timed(
    name: str, move: Callable[[int], None], count: int, view: Callable[[], Any]
) -> dict[str, Any]:
    seconds, pixels = [], []
    for i in range(count):
        begun = time.perf_counter()
        move(i)
        seconds.append(1e3 * (time.perf_counter() - begun))
        if view().pixels is None or view().message:
            raise PavError(f"the 3D view shows no picture: {view().message or 'no reason given'}")
        pixels.append(view().pixels.display.shape[1])
    return {
        "what": name,
        "median ms": round(float(np.median(seconds)), 1),
        "worst ms": round(max(seconds), 1),
        "pixels across": int(np.median(pixels)),
    }


@contextmanager
def _alone(viewport: Any) -> Iterator[None]:
    """No refining beside what is measured: while things move, Blender asks for the next picture
    at once, and the thread that refines stands aside."""
    with viewport.turns.first():
        yield


@contextmanager
def _together() -> Iterator[None]:
    yield


def _wait(ready: Callable[[], bool], view: Any) -> None:
    end = time.monotonic() + _PATIENCE_S
    while not ready():
        if time.monotonic() > end:
            raise PavError(f"the 3D view's picture is not ready after {_PATIENCE_S:g} s")
        time.sleep(0.001)


def _sight(camera: Any, depsgraph: Any, turn: float) -> tuple[Any, Any]:
    """A region and its data as of a free 3D view: the camera's, turned about the world's axis."""
    from mathutils import Matrix

    width, height = _SIZE
    matrix = Matrix.Rotation(turn, 4, "Z") @ camera.evaluated_get(depsgraph).matrix_world
    projection = camera.calc_matrix_camera(depsgraph, x=width, y=height, scale_x=1, scale_y=1)
    return SimpleNamespace(width=width, height=height), SimpleNamespace(
        view_matrix=matrix.inverted(),
        window_matrix=projection,
        is_perspective=True,
    )


def _add_grid(bpy: Any) -> None:
    """A wavy sheet behind the head."""
    side = np.linspace(-2, 2, _MANY + 1)
    x, z = np.meshgrid(side, side)
    y = 0.6 + 0.1 * np.sin(5 * x) * np.cos(5 * z)
    row = np.arange(_MANY)
    corner = (row[:, None] * (_MANY + 1) + row).ravel()
    faces = np.stack([corner, corner + 1, corner + _MANY + 2, corner + _MANY + 1], 1)
    mesh = bpy.data.meshes.new("sheet")
    mesh.from_pydata(np.stack([x, y, z], -1).reshape(-1, 3), [], faces)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("sheet", mesh))


def _rasterised() -> float:
    """Milliseconds to draw 100,000 triangles that fill the picture."""
    from ..core.rendering.cameras import Camera
    from ..core.rendering.solids import Shape, Solid, gather, picture

    side = np.linspace(-1, 1, 225)
    x, y = np.meshgrid(side, side)
    vertices = np.stack([x, y, 0.1 * np.sin(9 * x) * np.cos(9 * y)], -1).reshape(-1, 3)
    corner = (np.arange(224)[:, None] * 225 + np.arange(224)).ravel()
    lower, upper = corner + np.array([[0], [1], [225]]), corner + np.array([[1], [226], [225]])
    faces = np.concatenate([lower.T, upper.T]).astype(np.int32)
    shape = Shape(
        vertices.astype(np.float32),
        faces,
        vertices.astype(np.float32),
        faces,
        np.zeros(len(faces), np.int32),
    )
    pose = np.eye(4)
    pose[2, 3] = -1.2
    focal = _SIZE[0] / 1.6
    camera = Camera(
        *_SIZE, np.array([[focal, 0, _SIZE[0] / 2], [0, focal, _SIZE[1] / 2], [0, 0, 1]]), pose
    )
    solids = [Solid(shape, np.eye(4), np.array([[0.8, 0.8, 0.8]], np.float32))]
    soup, seconds = gather(solids), []
    for _ in range(10):
        begun = time.perf_counter()
        picture(solids, camera, soup)
        seconds.append(time.perf_counter() - begun)
    return 1e3 * float(np.median(seconds))
