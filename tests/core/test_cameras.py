from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pav_blender.core.errors import InputError
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.rendering.rasterise import rasterise


def camera(seed=0, width=64, height=48):
    random = np.random.default_rng(seed)
    q, _ = np.linalg.qr(random.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = q * np.sign(np.linalg.det(q))
    pose[:3, 3] = random.normal(size=3)
    focal = random.uniform(40, 200)
    cx, cy = width / 2 + 3, height / 2 - 2
    intrinsics = np.array([[focal, 0.5, cx], [0, focal * 1.1, cy], [0, 0, 1]])
    return Camera(width, height, intrinsics, pose)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 5.0), st.booleans())
def test_a_ray_through_a_pixel_projects_back_into_it(seed, distance, parallel):
    view = replace(camera(seed), parallel=parallel)
    x, y = np.array([0, 10, 63]), np.array([0, 47, 20])
    origins, directions, cosine = view.rays(x, y)
    points = origins.astype(np.float64) + directions.astype(np.float64) * distance
    pixels, depth = view.project(points)
    np.testing.assert_allclose(pixels, np.stack([x, y], 1) + 0.5, atol=2e-3)
    np.testing.assert_allclose(depth, distance * cosine, rtol=1e-5)


def test_windows_and_sizes_see_the_same_points():
    view, points = camera(1), np.random.default_rng(2).normal(size=(20, 3))
    pixels, _ = view.project(points)
    np.testing.assert_allclose(view.window(5, 7, 30, 40).project(points)[0], pixels - [5, 7])
    np.testing.assert_allclose(view.resized(128, 96).project(points)[0], pixels * 2)


@pytest.mark.parametrize(
    "change",
    [
        {"intrinsics": np.full((3, 3), np.nan)},
        {"intrinsics": np.diag([-1.0, 1, 1])},
        {"camera_to_world": np.eye(3)},
        {"width": 0},
    ],
)
def test_what_is_no_camera_is_refused(change):
    values = {"width": 4, "height": 4, "intrinsics": np.eye(3), "camera_to_world": np.eye(4)}
    with pytest.raises(InputError, match="camera"):
        Camera(**(values | change))


def test_the_rasteriser_agrees_with_rays_cast_at_every_pixel():
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    pose = np.eye(4)
    pose[:3, 3] = [0.05, 0.02, -1.5]
    view = Camera(40, 30, np.array([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]]), pose)
    vertices, triangles = np.array(mesh.vertices), np.array(mesh.faces)
    depth, index, barycentric = rasterise(vertices, triangles, view)
    y, x = np.indices(depth.shape).reshape(2, -1)
    _, directions, cosine = view.rays(x, y)
    expected = np.full(len(x), np.inf)
    corners = vertices[triangles]
    for a, b, c in corners:  # Moeller and Trumbore, one triangle at a time
        e1, e2, s = b - a, c - a, view.origin - a
        p = np.cross(directions, e2)
        det = p @ e1
        u, q = (p @ s) / det, np.cross(s, e1)
        v, t = directions @ q / det, (q @ e2) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        expected = np.where(hit, np.minimum(expected, t), expected)
    expected = (expected * cosine).reshape(depth.shape)
    edge = np.isfinite(expected) != np.isfinite(depth)
    assert edge.mean() < 0.005
    both = np.isfinite(expected) & np.isfinite(depth)
    assert both.sum() > 400
    np.testing.assert_allclose(depth[both], expected[both], rtol=1e-4)
    points = (corners[index[both]] * barycentric[both][:, :, None]).sum(1)
    np.testing.assert_allclose(view.project(points)[1], depth[both], rtol=1e-4)


def test_triangles_behind_the_camera_or_without_area_draw_nothing():
    view = Camera(8, 8, np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), np.eye(4))
    vertices = np.array([[-1, -1, -1], [1, -1, -1], [0, 1, -1], [0, 0, 1], [0, 0, 1.0]])
    depth, _, _ = rasterise(vertices, np.array([[0, 1, 2], [0, 3, 4], [3, 4, 3]]), view)
    assert not np.isfinite(depth).any()


@pytest.mark.parametrize("turn", [np.zeros((3, 3)), 2 * np.eye(3), np.diag([1.0, 1, 0.01])])
def test_a_camera_that_does_not_turn_rigidly_is_told(turn):
    pose = np.eye(4)
    pose[:3, :3] = turn
    with pytest.raises(InputError, match="does not turn rigidly"):
        Camera(8, 8, np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), pose)


def test_rays_that_begin_further_on_are_the_same_rays():
    view = Camera(8, 8, np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), np.eye(4))
    columns = rows = np.arange(8)
    near, directions, cosine = view.rays(columns, rows)
    far, again, same = view.rays(columns, rows, 32.0)
    np.testing.assert_array_equal(again, directions)
    np.testing.assert_array_equal(same, cosine)
    np.testing.assert_allclose(far, near + 32 * directions, rtol=1e-6)
