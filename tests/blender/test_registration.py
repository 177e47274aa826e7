"""What the 3D view computes, with the real renderer: where F12 has it, among solids."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
from mathutils import Matrix, Vector

from pav_blender.bridge import final, sight, viewport
from pav_blender.bridge import render as bridge_render
from pav_blender.bridge.scene import build_scene
from pav_blender.bridge.shot import read_shot
from pav_blender.core.collection import read_collection

SIZE = (96, 80)


@pytest.fixture
def made(scene, files):
    made = build_scene(files / "small.pav", read_collection(files / "collection"), "walk")
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = SIZE
    bpy.context.scene.pav.quality = "PREVIEW"
    return made


def depsgraph():
    bpy.context.view_layer.update()
    return bpy.context.evaluated_depsgraph_get()


def camera_sight(camera):
    """A region that the camera's frame fills exactly, and its data."""
    graph = depsgraph()
    render = bpy.context.scene.render
    region = SimpleNamespace(width=SIZE[0], height=SIZE[1])
    window = camera.calc_matrix_camera(
        graph, x=SIZE[0], y=SIZE[1], scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    matrix = camera.matrix_world.normalized().inverted()
    data = SimpleNamespace(
        view_matrix=matrix,
        window_matrix=window,
        perspective_matrix=window @ matrix,
        is_perspective=camera.data.type == "PERSP",
        view_perspective="CAMERA",
    )
    return region, data


def finest(camera):
    view = viewport.View()
    view.update(depsgraph())
    shot = bridge_render.Shot(
        view.actors, camera, (0, 0, camera.width, camera.height), "preview", view.background,
        0, view.solids,
    )  # fmt: skip
    outcome = viewport._draw(shot, 3, lambda: False)
    assert outcome.message == ""
    return outcome.pixels


@pytest.mark.parametrize("moved", [False, True])
def test_the_cameras_view_is_the_final_picture(made, moved):
    if moved:
        made.camera.data.shift_x, made.camera.data.shift_y = 0.07, -0.05
    ours = finest(sight.view_camera(*camera_sight(made.camera)))
    theirs = bridge_render.draw(read_shot(None, depsgraph()))
    assert (theirs.display[..., 3] > 0.5).mean() > 0.05
    np.testing.assert_allclose(ours.display, theirs.display, atol=2e-3)
    assert final is not None


def test_a_parallel_view_is_what_a_long_lens_sees_from_far_away(made):
    made.camera.animation_data_clear()
    lens = made.camera.data
    lens.animation_data_clear()
    lens.type, lens.ortho_scale, lens.sensor_fit = "ORTHO", 0.5, "HORIZONTAL"
    lens.shift_x, lens.shift_y = 0.05, -0.1
    parallel = finest(sight.view_camera(*camera_sight(made.camera)))
    lens.type, lens.lens = "PERSP", lens.sensor_width * 60 / 0.5
    made.camera.matrix_world = made.camera.matrix_world @ Matrix.Translation((0, 0, 60 - 0.7))
    far = finest(sight.view_camera(*camera_sight(made.camera)))
    one, other = parallel.display[..., 3] > 0.5, far.display[..., 3] > 0.5
    assert 0.1 < one.mean() < 0.9
    assert (one != other).mean() < 0.01
    rolled = np.roll(one, 1, 1)
    assert (one != other).sum() < 0.3 * (one != rolled).sum()


def test_a_wall_before_the_head_hides_it_and_one_behind_shows_through(made):
    camera = sight.view_camera(*camera_sight(made.camera))
    alone = finest(camera)
    head = alone.display[..., 3]
    assert head.max() > 0.9
    matrix = made.camera.matrix_world
    bpy.ops.mesh.primitive_plane_add(size=9)
    wall = bpy.context.object
    wall.rotation_euler = matrix.to_euler()
    away = alone.depth[head > 0.5]
    wall.location = matrix @ Vector((0, 0, -(float(away.min()) - 0.1)))
    before = finest(camera)
    assert np.ptp(before.combined[..., :3]) < 1e-3  # nothing but the wall
    np.testing.assert_allclose(before.depth, away.min() - 0.1, rtol=1e-3)
    wall.location = matrix @ Vector((0, 0, -5))
    behind = finest(camera)
    np.testing.assert_allclose(behind.display, alone.display, atol=1e-5)
    grey = behind.combined[head == 0]
    np.testing.assert_allclose(grey, np.tile(grey[:1], (len(grey), 1)), atol=1e-4)
    expected = alone.combined[..., :3] + (1 - head[..., None]) * grey[0, :3]
    np.testing.assert_allclose(behind.combined[..., :3], expected, atol=1e-4)
    through = matrix @ Vector((0, 0, -float(np.median(away))))
    wall.location = through
    cut = finest(camera)
    assert cut.depth.max() <= np.median(away) * 1.001
    assert (np.abs(cut.combined - behind.combined).max(-1) > 0.05).mean() > 0.02


def test_only_the_border_is_drawn(made):
    region, data = camera_sight(made.camera)
    space = SimpleNamespace(camera=made.camera, use_render_border=False)
    scene = bpy.context.scene
    assert sight.view_border(region, data, space, scene) == (0, 0, *SIZE)
    settings = scene.render
    settings.use_border = True
    settings.border_min_x, settings.border_max_x = 0.25, 0.75
    settings.border_min_y, settings.border_max_y = 0.25, 1.0
    assert sight.view_border(region, data, space, scene) == (24, 0, 72, 60)
    data.view_perspective = "PERSP"
    assert sight.view_border(region, data, space, scene) == (0, 0, *SIZE)
    space.use_render_border = True
    space.render_border_min_x, space.render_border_max_x = 0.5, 0.5
    space.render_border_min_y, space.render_border_max_y = 0.0, 1.0
    assert sight.view_border(region, data, space, scene) == (0, 0, 0, 0)


def test_a_pose_is_found_once_however_the_camera_or_the_head_moves(made, monkeypatch):
    from pav_blender.core.rendering import render as core_render

    posed = []
    real = core_render.pose_scene
    monkeypatch.setattr(core_render, "pose_scene", lambda *a: posed.append(a) or real(*a))
    viewport._posed.forget()
    camera = sight.view_camera(*camera_sight(made.camera))
    finest(camera)
    finest(camera.resized(50, 40))
    made.armature.location.x += 0.1
    finest(camera)
    assert len(posed) == 1
    bpy.context.scene.frame_set(5)
    finest(camera)
    made.mesh.pav.appearance = "evening"
    finest(camera)
    assert len(posed) == 3
    made.armature.matrix_world = Matrix.Diagonal((1, 1, 1.2, 1)) @ made.armature.matrix_world
    finest(camera)
    assert len(posed) == 4
