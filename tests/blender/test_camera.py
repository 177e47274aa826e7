"""Cameras agree with Blender's own projection, in both directions."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector

from pav_blender.bridge import axes, lens, shot
from pav_blender.core.errors import InputError
from pav_blender.core.rendering.cameras import Camera

FITS = ("AUTO", "HORIZONTAL", "VERTICAL")


def add_camera(scene, rng):
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.rotation_euler = rng.uniform(-3, 3, 3)
    camera.location = rng.uniform(-2, 2, 3)
    return camera


def points_before(camera, rng):
    """Points in front of a Blender camera, in Blender's world."""
    local = np.concatenate([rng.uniform(-0.4, 0.4, (20, 2)), rng.uniform(-3, -1, (20, 1))], 1)
    return np.array([camera.matrix_world @ Vector(point) for point in local])


def blender_pixels(scene, camera, points):
    width, height = lens.frame_size(scene.render)
    view = np.array([world_to_camera_view(scene, camera, Vector(point)) for point in points])
    return np.stack([view[:, 0] * width, (1 - view[:, 1]) * height], 1), view[:, 2]


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize("size", [(640, 360), (300, 500), (256, 256)])
@pytest.mark.parametrize("aspect", [(1.0, 1.0), (1.5, 1.0), (1.0, 2.0)])
@pytest.mark.parametrize("percentage", [100, 50])
def test_blender_camera_to_core(scene, fit, size, aspect, percentage):
    rng = np.random.default_rng(hash((fit, size, aspect, percentage)) % 2**32)
    render = scene.render
    render.resolution_x, render.resolution_y = size
    render.resolution_percentage = percentage
    render.pixel_aspect_x, render.pixel_aspect_y = aspect
    camera = add_camera(scene, rng)
    data = camera.data
    data.sensor_fit, data.lens = fit, rng.uniform(20, 90)
    data.sensor_width, data.sensor_height = 36, 20
    data.shift_x, data.shift_y = rng.uniform(-0.3, 0.3, 2)
    bpy.context.view_layer.update()
    points = points_before(camera, rng)
    expected, depth = blender_pixels(scene, camera, points)

    read = lens.read_lens(data, render)
    explicit = Camera(
        read.width,
        read.height,
        lens.to_intrinsics(read),
        axes.camera_to_core(np.array(camera.matrix_world)),
    )
    depsgraph = bpy.context.evaluated_depsgraph_get()
    through = shot.scene_camera(None, camera, depsgraph, read.width, read.height)
    for made in (explicit, through):
        pixels, found_depth = made.project(axes.points_to_core(points))
        np.testing.assert_allclose(pixels, expected, atol=2e-2)
        np.testing.assert_allclose(found_depth, depth, atol=1e-5)


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize("size", [(640, 360), (300, 500)])
@pytest.mark.parametrize("ratio", [1.0, 0.6, 1.7])
def test_core_camera_to_blender(scene, fit, size, ratio):
    rng = np.random.default_rng(3)
    width, height = size
    focal = rng.uniform(400, 900)
    intrinsics = np.array([[focal * ratio, 0, 210.3], [0, focal, 155.8], [0, 0, 1]])
    made = lens.from_intrinsics(intrinsics, width, height, sensor_fit=fit)
    np.testing.assert_allclose(lens.to_intrinsics(made), intrinsics, atol=1e-9)

    camera = add_camera(scene, rng)
    camera_to_world = axes.camera_to_core(np.array(camera.matrix_basis))
    camera.matrix_world = Matrix(axes.camera_to_blender(camera_to_world).tolist())
    camera.data.sensor_fit, camera.data.lens = fit, made.lens
    camera.data.sensor_width, camera.data.sensor_height = made.sensor_width, made.sensor_height
    camera.data.shift_x, camera.data.shift_y = made.shift_x, made.shift_y
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = made.aspect_x, made.aspect_y
    bpy.context.view_layer.update()
    points = points_before(camera, rng)
    expected, _ = blender_pixels(scene, camera, points)
    core = Camera(width, height, intrinsics, camera_to_world)
    pixels, _ = core.project(axes.points_to_core(points))
    np.testing.assert_allclose(pixels, expected, atol=2e-2)


def test_odd_percentages_are_cut_off_as_blender_does(scene):
    # 236.8 x 133.2 pixels: world_to_camera_view knows no cut, the projection matrix does
    scene.render.resolution_x, scene.render.resolution_y = 640, 360
    scene.render.resolution_percentage = 37
    camera = add_camera(scene, np.random.default_rng(5))
    camera.data.shift_x, camera.data.sensor_fit = 0.1, "VERTICAL"
    read = lens.read_lens(camera.data, scene.render)
    assert (read.width, read.height) == (236, 133)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    through = shot.scene_camera(None, camera, depsgraph, 236, 133)
    np.testing.assert_allclose(through.intrinsics, lens.to_intrinsics(read), atol=1e-3)


def test_skew_and_orthographic_are_refused(scene):
    with pytest.raises(InputError, match="skew"):
        lens.from_intrinsics([[500, 3, 128], [0, 500, 128], [0, 0, 1]], 256, 256)
    camera = add_camera(scene, np.random.default_rng(0))
    camera.data.type = "ORTHO"
    with pytest.raises(InputError, match="ORTHO"):
        lens.read_lens(camera.data, scene.render)
    with pytest.raises(InputError, match="perspective"):
        shot.scene_camera(None, camera, bpy.context.evaluated_depsgraph_get(), 64, 64)


def test_axes_turn_up_into_blenders_up():
    np.testing.assert_array_equal(axes.points_to_blender(np.array([[1.0, 2, 3]])), [[1, -3, 2]])
    points = np.random.default_rng(1).normal(size=(5, 3))
    np.testing.assert_array_equal(axes.points_to_core(axes.points_to_blender(points)), points)
    homogeneous = np.append(points[0], 1)
    turned = axes.points_to_blender(points)[0]
    np.testing.assert_allclose(axes.TO_BLENDER @ homogeneous, [*turned, 1])
