"""The compiled rasteriser of solids against every triangle at every pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pav_blender.core.kernels import select
from pav_blender.core.kernels.soup import Lights, Soup
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.rendering.solids import Gatherer, Shape, Solid, compose, farthest, picture

CPU, REFERENCE = select("cpu").solids, select("cpu", reference=True).solids
LIGHTS = Lights(np.array([[-0.4, -0.5, -0.5], [0.2, 0.1, -0.1]]), 0.1)
SIZE = (53, 37)


def soup_of(corners, materials=1, normals=None, owner=None):
    """Triangles [T, 3, 3] with corners of their own; normals as they stand, or [3 T, 3]."""
    corners = np.asarray(corners, np.float32)
    count = len(corners)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    index = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    return Soup(
        corners.reshape(-1, 3),
        np.zeros(3 * count, np.int32) if owner is None else np.repeat(owner, 3).astype(np.int32),
        index,
        np.repeat(flat, 3, 0).astype(np.float32) if normals is None else normals,
        index,
        (np.arange(count) % materials).astype(np.int32),
    )


def pinhole(focal=40.0):
    matrix = np.zeros((4, 4))
    matrix[0, 0] = matrix[1, 1] = focal
    matrix[0, 2], matrix[1, 2] = SIZE[0] / 2, SIZE[1] / 2
    matrix[2, 2] = matrix[3, 2] = 1.0
    return matrix


def parallel(scale=20.0):
    matrix = np.diag([scale, scale, 0.0, 0.0])
    matrix[0, 3], matrix[1, 3], matrix[2, 3] = SIZE[0] / 2, SIZE[1] / 2, 1.0
    matrix[3, 2] = 1.0
    return matrix


def both(soup, matrices, turns=None, near=0.05):
    matrices = np.asarray(matrices, np.float64).reshape(-1, 4, 4)
    turns = np.tile(np.eye(3), (len(matrices), 1, 1)) if turns is None else turns
    palette = np.array([[1, 1, 1], [0.8, 0.1, 0.1], [0.1, 0.7, 0.3]], np.float32)
    arguments = soup, matrices, turns, palette, LIGHTS, SIZE, near
    return CPU.draw(*arguments), REFERENCE.draw(*arguments)


def check(soup, matrices, turns=None):
    """Same pixels but for edges that pass within rounding of a pixel's centre."""
    (colour, depth), (expected, truth) = both(soup, matrices, turns)
    assert (np.isfinite(depth) != np.isfinite(truth)).sum() <= 2
    seen = np.isfinite(depth) & np.isfinite(truth)
    close = np.isclose(depth, truth, rtol=1e-5) & seen
    assert (seen & ~close).sum() <= 2
    assert np.isclose(colour, expected, atol=1e-4)[close].mean() > 0.995
    return colour, depth


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_random_triangles_are_where_the_reference_sees_them(seed, orthographic):
    rng = np.random.default_rng(seed)
    count = 80
    centres = np.stack(
        [rng.normal(size=count), rng.normal(size=count), rng.uniform(-1.0, 4.0, count)], 1
    )
    corners = centres[:, None] + rng.normal(size=(count, 3, 3)) * rng.choice(
        [0.05, 0.4, 2.0], (count, 1, 1)
    )
    corners[::9, 1] = corners[::9, 0]  # no area
    corners[4::11] = corners[3::11][: len(corners[4::11])]  # twice the same
    normals = rng.normal(size=(3 * count, 3)).astype(np.float32)
    check(soup_of(corners, 3, normals), parallel() if orthographic else pinhole())


def test_values_that_are_not_finite_draw_nothing():
    corners = np.array(
        [[[np.nan, 0, 1], [1, 0, 1], [0, 1, 1]], [[np.inf, 0, 1], [1, 0, 1], [0, 1, 1]]]
    )
    with np.errstate(invalid="ignore"):
        (_, depth), _ = both(soup_of(corners), pinhole())
    assert not np.isfinite(depth).any()


def grid(size):
    """A square [-1, 1]^2 of 2 (size - 1)^2 triangles with shared corners, in no order."""
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.linspace(-1, 1, size), np.linspace(-1, 1, size))
    u[1:-1, 1:-1] += rng.uniform(-0.3, 0.3, (size - 2, size - 2)) / size
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + size], 1)
    upper = np.stack([corner + 1, corner + size + 1, corner + size], 1)
    triangles = rng.permutation(np.concatenate([lower, upper])).astype(np.int32)
    vertices = np.stack([u, v, np.zeros_like(u)], -1).reshape(-1, 3).astype(np.float32)
    count = len(triangles)
    return Soup(vertices, np.zeros(size * size, np.int32), triangles,
                np.array([[0, 0, 1]], np.float32), np.zeros((count, 3), np.int32),
                np.zeros(count, np.int32))  # fmt: skip


@pytest.mark.parametrize("size", [2, 3, 60])
def test_a_surface_of_many_triangles_has_no_seam(size):
    place = np.eye(4)
    place[2, 3] = 0.5
    colour, depth = CPU.draw(grid(size), (pinhole() @ place)[None], np.eye(3)[None],
                             np.ones((1, 3), np.float32), LIGHTS, SIZE, 0.05)  # fmt: skip
    np.testing.assert_allclose(depth, 0.5, rtol=1e-6)
    assert np.ptp(colour) < 1e-6
    assert colour.min() > 0.3


def test_a_floor_through_the_camera_ends_at_the_horizon():
    """Two triangles, metres wide, that begin behind the camera: y = 1 (down) wherever one looks."""
    far = 1e4
    a, b, c, d = (-far, 1, -far), (far, 1, -far), (far, 1, far), (-far, 1, far)
    _, depth = check(soup_of([[a, b, c], [a, c, d]]), pinhole())
    rows = np.arange(SIZE[1]) + 0.5
    below = rows > SIZE[1] / 2
    with np.errstate(divide="ignore"):
        expected = 40.0 / (rows - SIZE[1] / 2)
    assert np.isinf(depth[~below]).all()
    np.testing.assert_allclose(
        depth[below], np.tile(expected[below][:, None], (1, SIZE[0])), rtol=1e-5
    )


def test_nearer_than_near_is_not_seen():
    corners = [[(-9, -9, 0.04), (9, -9, 0.04), (0, 9, 0.04)], [(-9, -9, 2), (9, -9, 2), (0, 20, 2)]]
    (_, depth), _ = both(soup_of(corners), pinhole())
    np.testing.assert_allclose(depth, 2.0)


def test_both_sides_are_lit_and_a_mirror_changes_nothing():
    front = [[(-1, -1, 2), (-1, 1, 2), (1, -1, 2)]]  # anticlockwise as seen
    back = [[(-1, -1, 2), (1, -1, 2), (-1, 1, 2)]]
    one, _ = check(soup_of(front), pinhole())
    two, _ = check(soup_of(back), pinhole())
    np.testing.assert_allclose(one, two, atol=1e-6)
    assert one.max() > 0.4
    mirror = np.diag([-1.0, 1, 1, 1])
    turned = np.diag([-1.0, 1, 1])[None]
    mirrored = [[(1, -1, 2), (1, 1, 2), (-1, -1, 2)]]
    three, _ = check(soup_of(mirrored), pinhole() @ mirror, turned)
    np.testing.assert_allclose(one, three, atol=1e-6)


def test_objects_have_their_own_places():
    corners = np.array([[(-1, -1, 0), (1, -1, 0), (0, 1, 0)]] * 2)
    places = np.tile(np.eye(4), (2, 1, 1))
    places[0, 2, 3], places[1, 2, 3] = 3.0, 2.0
    places[1, :3, :3] *= 0.5
    soup = soup_of(corners, 2, owner=np.array([0, 1]))
    colour, depth = check(soup, pinhole() @ places, np.tile(np.eye(3), (2, 1, 1)))
    assert set(np.unique(np.round(depth, 4))) == {2.0, 3.0, np.inf}
    assert colour[depth < 2.5][:, 1].max() < colour[np.isclose(depth, 3)][:, 1].min()


def ball(place, colour, radius=0.2):
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    vertices, faces = np.float32(mesh.vertices), np.int32(mesh.faces)
    shape = Shape(vertices, faces, vertices, faces, np.zeros(len(faces), np.int32))
    pose = np.eye(4)
    pose[:3, 3] = place
    return Solid(shape, pose, np.float32([colour]))


def view(width=40, height=30, orthographic=False):
    focal = 40.0 if orthographic else 60.0
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(width, height, intrinsics, np.eye(4), parallel=orthographic)


@pytest.mark.parametrize("orthographic", [False, True])
def test_solids_lie_where_the_camera_projects_them(orthographic):
    things = [ball((0.1, -0.05, 1.5), (0.8, 0.2, 0.2)), ball((0.1, -0.05, 3), (0.1, 0.1, 0.9))]
    camera = view(orthographic=orthographic)
    colour, depth = picture(things, camera)
    pixels, away = camera.project(np.array([[0.1, -0.05, 1.5]]))
    x, y = np.floor(pixels[0]).astype(int)
    assert abs(depth[y, x] - (away[0] - 0.2)) < 0.01
    assert colour[y, x, 0] > 3 * colour[y, x, 2] > 0
    rows, columns = np.nonzero(depth < 2)
    size = 0.2 * (40 if orthographic else 60 / np.sqrt(1.5**2 - 0.2**2))
    assert abs(np.ptp(columns) + 1 - 2 * size) <= 1.5
    assert np.allclose([columns.mean() + 0.5, rows.mean() + 0.5], pixels[0], atol=0.6)


def test_soups_are_gathered_again_only_for_other_shapes():
    keep = Gatherer()
    one, other = ball((0, 0, 2), (1, 0, 0)), ball((0, 0, 3), (0, 1, 0))
    soup = keep([one, other])
    moved = Solid(one.shape, np.diag([2.0, 2, 2, 1]), np.float32([[0, 0, 1]]))
    assert keep([moved, other]) is soup
    assert keep([other, one]) is not soup
    assert soup.owner.max() == 1
    assert soup.triangles.max() == len(soup.vertices) - 1
    camera = view()
    for kept, fresh in zip(
        picture([moved, other], camera, soup), picture([moved, other], camera), strict=True
    ):
        np.testing.assert_array_equal(kept, fresh)


def test_each_pixel_shows_what_is_nearer():
    """A half transparent avatar 2 m away; solids before it, behind it, and none."""
    rgba = np.tile(np.float32([1, 1, 1, 0.5]), (1, 4, 1))
    rgba[0, 3] = 0
    depth = np.float32([[2, 2, 2, np.inf]])
    solid = np.float32([[[0.5, 0, 0]] * 4])
    away = np.float32([[1, 3, np.inf, 3]])
    whole, distance = compose(rgba, depth, solid, away, (0, 0, 1))
    np.testing.assert_allclose(whole[0, 0], [0.5, 0, 0, 1])
    np.testing.assert_allclose(whole[0, 1], [0.75, 0.5, 0.5, 1])
    np.testing.assert_allclose(whole[0, 2], [0.5, 0.5, 1, 1])
    np.testing.assert_allclose(whole[0, 3], [0.5, 0, 0, 1])
    np.testing.assert_array_equal(distance, [[1, 2, 2, 3]])
    clear, _ = compose(rgba, depth, solid, away, None)
    np.testing.assert_allclose(clear[0, 2], [0.5, 0.5, 0.5, 0.5])


def test_samples_smooth_edges_or_enlarge():
    rgba = np.float32([[[1, 1, 1, 1]]])
    depth = np.float32([[2]])
    colour = np.zeros((2, 2, 3), np.float32)
    away = np.float32([[1, 3], [np.inf, 3]])
    assert np.isinf(farthest(away, 2)).all()
    whole, _ = compose(rgba, depth, colour, away, None)
    np.testing.assert_allclose(whole[0, 0], [0.75, 0.75, 0.75, 1])
    large, distance = compose(rgba, depth, colour, away, None, enlarged=True)
    np.testing.assert_allclose(large[..., 0], [[0, 1], [1, 1]])
    np.testing.assert_array_equal(distance, [[1, 2], [2, 2]])
