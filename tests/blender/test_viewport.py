"""The 3D view's camera, and which picture it shows while things change (drawing needs a window)."""

from __future__ import annotations

import threading
import time
import weakref
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("bpy")

from mathutils import Matrix, Vector

from pav_blender.bridge import axes, turns, viewport
from pav_blender.bridge.render import Pixels
from pav_blender.core.errors import Cancelled
from pav_blender.core.rendering.cameras import Camera

WIDTH, HEIGHT = 320, 200


def region_data(perspective):
    location = Vector((0.2, -0.1, 0.3))
    pose = Matrix.Translation((0.4, -2.0, 0.7)) @ Matrix.Rotation(1.2, 4, "X")
    near, far, half = 0.01, 100.0, (0.004, 0.0025)
    if perspective:
        window = Matrix(
            (
                (near / half[0], 0, 0.15, 0),
                (0, near / half[1], -0.2, 0),
                (0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)),
                (0, 0, -1, 0),
            )
        )
    else:
        window = Matrix(
            ((1 / 0.8, 0, 0, 0.1), (0, 1 / 0.5, 0, -0.05), (0, 0, -0.02, 0), (0, 0, 0, 1))
        )
    return SimpleNamespace(
        view_matrix=pose.inverted(),
        window_matrix=window,
        perspective_matrix=window @ pose.inverted(),
        is_perspective=perspective,
        view_location=location,
    )


def pixels_of(matrix, points):
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], 1) @ np.array(matrix).T
    ndc = homogeneous[:, :2] / homogeneous[:, 3:]
    return np.stack([(ndc[:, 0] + 1) / 2 * WIDTH, (1 - ndc[:, 1]) / 2 * HEIGHT], 1)


@pytest.mark.parametrize("perspective", [True, False])
def test_view_camera_equals_the_views_matrices(perspective):
    data = region_data(perspective)
    camera = viewport.view_camera(SimpleNamespace(width=WIDTH, height=HEIGHT), data)
    rng = np.random.default_rng(0)
    points = np.array(data.view_location) + rng.uniform(-0.15, 0.15, (30, 3))
    expected = pixels_of(data.perspective_matrix, points)
    found, depth = camera.project(axes.points_to_core(points))
    assert (depth > 0).all()
    assert np.ptp(expected, 0).min() > 20
    np.testing.assert_allclose(found, expected, atol=0.01)


class Renderer:
    """Takes the place of `draw`: remembers the sizes asked for; finer ones may take `delay`."""

    def __init__(self):
        self.sizes = []
        self.asked = []
        self.delay = 0.0

    def scene(self, actor):
        """Of `Posed`."""

    def __call__(self, shot, should_stop, posed):
        self.sizes.append(shot.camera.width)
        end = time.monotonic() + (self.delay if shot.camera.width > 40 else 0)
        while time.monotonic() < end:
            if should_stop():
                raise Cancelled("stopped")
            time.sleep(0.001)
        blank = np.zeros((shot.camera.height, shot.camera.width, 4), np.float32)
        return Pixels(blank, blank[..., 0], blank)


@pytest.fixture
def renderer(monkeypatch):
    made = Renderer()
    monkeypatch.setattr(viewport, "draw", made)
    monkeypatch.setattr(viewport, "_ask", made.asked.append)
    monkeypatch.setattr(viewport, "_coarsest", lambda *_: 0)
    monkeypatch.setattr(viewport, "_posed", made)
    monkeypatch.setattr(viewport, "_warm", True)
    return made


def camera(shift=0.0):
    pose = np.eye(4)
    pose[0, 3] = shift
    return Camera(WIDTH, HEIGHT, np.diag([300.0, 300, 1]), pose)


def refine(view):
    viewport.refine(weakref.ref(view))


def test_coarse_first_then_finer_then_nothing(renderer):
    view = viewport.View(actors=(object(),))
    view.look(camera())
    assert renderer.sizes == [40]
    refine(view)
    assert renderer.sizes == [40, 80, 160, 320]
    assert view.pixels.depth.shape == (HEIGHT, WIDTH)
    view.look(camera())
    assert renderer.sizes == [40, 80, 160, 320]


def test_a_moved_camera_and_changed_data_begin_again(renderer):
    view = viewport.View(actors=(object(),))
    view.look(camera())
    view.look(camera(0.1))
    view.changed = True
    view.look(camera(0.1))
    assert renderer.sizes == [40, 40, 40]


def start_refining(renderer, view):
    """Begins a refinement on a thread that would take 20 s; the time when it had begun."""
    renderer.delay = 20.0
    threading.Thread(target=viewport.refine, args=(weakref.ref(view),), daemon=True).start()
    while len(renderer.sizes) < 2:
        time.sleep(0.001)
    return time.monotonic()


def test_refining_ends_when_the_view_moved_on(renderer):
    view = viewport.View(actors=(object(),))
    view.look(camera())
    begun = start_refining(renderer, view)
    view.look(camera(0.1))
    assert time.monotonic() - begun < 5
    assert renderer.sizes == [40, 80, 40]
    assert view.pixels.depth.shape[1] == 40


def test_a_closed_view_does_not_keep_the_next_one_waiting(renderer):
    """Blender drops the engine, and its view, at every switch of shading."""
    old = viewport.View(actors=(object(),))
    old.look(camera())
    begun = start_refining(renderer, old)
    del old
    new = viewport.View(actors=(object(),))
    new.look(camera())
    assert time.monotonic() - begun < 5
    assert new.pixels.depth.shape[1] == 40


def test_refining_steps_aside_and_is_asked_for_again(renderer):
    view = viewport.View(actors=(object(),))
    view.look(camera())
    renderer.asked.clear()
    begun = start_refining(renderer, view)
    with turns.first():
        while not renderer.asked:
            assert time.monotonic() - begun < 5
            time.sleep(0.001)
    assert renderer.asked == [weakref.ref(view)]
    assert view.share == 1


@pytest.mark.parametrize(("rate", "share"), [(1e2, 0), (100_000, 1), (1e9, 3)])
def test_the_first_picture_is_as_fine_as_can_be_waited_for(monkeypatch, rate, share):
    monkeypatch.setattr(viewport, "_rate", rate)
    assert viewport._coarsest(camera(), 0.06) == share


def test_the_first_picture_is_coarse_where_a_pose_took_all_the_time(renderer, monkeypatch):
    asked = []
    monkeypatch.setattr(viewport, "_coarsest", lambda _, seconds: asked.append(seconds) or 0)
    monkeypatch.setattr(renderer, "scene", lambda actor: time.sleep(0.03))
    viewport.View(actors=(object(),)).look(camera())
    assert asked[0] < viewport._COARSE_S - 0.03


def test_loading_happens_on_the_thread(renderer, monkeypatch):
    monkeypatch.setattr(viewport, "_warm", False)
    view = viewport.View(actors=(object(),))
    view.look(camera())
    assert (renderer.sizes, view.message) == ([], "Loading")
    refine(view)
    assert (renderer.sizes, view.message) == ([40, 80, 160, 320], "")
    view.look(camera(0.1))
    assert renderer.sizes[-1] == 40


def test_a_fault_becomes_the_views_message(renderer, monkeypatch):
    def fail(*_args, **_rest):
        raise ZeroDivisionError("seven")

    monkeypatch.setattr(viewport, "draw", fail)
    view = viewport.View(actors=(object(),))
    view.look(camera())
    assert view.message == "seven"
    assert view.pixels is None


def test_an_edit_elsewhere_keeps_the_picture(scene, renderer, tmp_path):
    import bpy
    import small

    from pav_blender.bridge.scene import build_head

    rig = build_head(small.write_avatar(tmp_path / "small.pav"))
    view = viewport.View()

    def sizes_after_update():
        bpy.context.view_layer.update()
        view.update(bpy.context.evaluated_depsgraph_get())
        view.look(camera())
        return len(renderer.sizes)

    assert sizes_after_update() == 1
    rig.mesh.select_set(True)
    assert sizes_after_update() == 1
    rig.mesh.data.shape_keys.key_blocks["jawOpen"].value = 0.4
    assert sizes_after_update() == 2
    rig.mesh.pav.appearance = "evening"
    assert sizes_after_update() == 3
    rig.armature.location.x = 0.1
    assert sizes_after_update() == 4
    scene.render.film_transparent = not scene.render.film_transparent
    assert sizes_after_update() == 5


def test_update_without_an_avatar_says_so(scene):
    import bpy

    view = viewport.View()
    view.update(bpy.context.evaluated_depsgraph_get())
    view.look(camera())
    assert "choose an avatar file" in view.message
