"""Nearest triangle: the compiled search against trying every triangle, on hostile meshes too."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pav_blender.core.kernels import select
from pav_blender.core.kernels.reference.nearest import closest_on_triangle

CPU, REFERENCE = select("cpu").nearest, select("cpu", reference=True).nearest


def grid_mesh(size: int, bump: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy square of 2 (size - 1)^2 triangles, 20 cm wide."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.linspace(-0.1, 0.1, size), np.linspace(-0.1, 0.1, size))
    height = bump * rng.normal(size=u.shape)
    vertices = np.stack([u, v, height], -1).reshape(-1, 3)
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + size], 1)
    upper = np.stack([corner + 1, corner + size + 1, corner + size], 1)
    return vertices.astype(np.float32), np.concatenate([lower, upper]).astype(np.int32)


def soup(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Unconnected triangles; among them points, lines, needles and copies."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(count, 3, 3)) * 0.02 + rng.normal(size=(count, 1, 3)) * 0.1
    corners[::7, 1] = corners[::7, 0]
    corners[3::11] = corners[3::11, :1]
    corners[5::13, 2] = 0.3 * corners[5::13, 0] + 0.7 * corners[5::13, 1]
    corners[6::17, 2] = corners[6::17, 1] + 1e-4 * rng.normal(size=(len(corners[6::17]), 3))
    corners[2::19] = corners[1::19][: len(corners[2::19])]
    vertices = corners.reshape(-1, 3).astype(np.float32)
    return vertices, np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def posed(kernels, vertices, triangles):
    triangles, vertices = torch.as_tensor(triangles), torch.as_tensor(vertices)
    return kernels.refit(kernels.Topology(triangles, vertices), vertices)


def ask(vertices, triangles, points):
    points = torch.as_tensor(np.asarray(points, np.float32))
    got = CPU.nearest(posed(CPU, vertices, triangles), points)
    want = REFERENCE.nearest(posed(REFERENCE, vertices, triangles), points)
    return points, got, want


def check(vertices, triangles, points, share: float = 0.97) -> None:
    """Same distances; a triangle that attains them; the same triangle but for near ties."""
    points, (triangle, barycentric, distance), (expected, _, best) = ask(
        vertices, triangles, points
    )
    scale = 1e-7 + 3e-7 * float(points[points.isfinite()].abs().max())
    assert torch.equal(triangle < 0, expected < 0)
    found = triangle >= 0
    torch.testing.assert_close(distance[found], best[found], rtol=2e-6, atol=scale)
    assert torch.all(distance[~found] == torch.inf)
    assert barycentric.isfinite().all()
    assert torch.all((barycentric >= 0) & (barycentric <= 1))
    torch.testing.assert_close(
        barycentric[found].sum(1), torch.ones(int(found.sum())), rtol=0, atol=1e-6
    )
    corners = torch.as_tensor(vertices)[torch.as_tensor(triangles).long()[triangle[found].long()]]
    foot = (corners * barycentric[found][..., None]).sum(1)
    torch.testing.assert_close(
        (foot - points[found]).norm(dim=1), best[found], rtol=1e-5, atol=3 * scale
    )
    assert (triangle == expected).float().mean() >= share


@pytest.mark.parametrize("size", [2, 4, 18, 40])  # one leaf up to three levels
def test_matches_brute_force_near_and_far(size):
    vertices, triangles = grid_mesh(size, 0.004)
    rng = np.random.default_rng(1)
    for spread in (0.02, 0.15, 3.0):
        check(vertices, triangles, rng.normal(size=(301, 3)) * spread, share=0.9)


def test_samples_along_rays():
    vertices, triangles = grid_mesh(30, 0.004)
    direction = np.random.default_rng(2).normal(size=(12, 3))
    steps = np.arange(-0.1, 0.1, 0.004)
    points = direction[:, None] / np.linalg.norm(direction, axis=1)[:, None, None] * steps[:, None]
    check(vertices, triangles, points.reshape(-1, 3))


@pytest.mark.parametrize("seed", range(4))
def test_hostile_triangles(seed):
    vertices, triangles = soup(150, seed)
    points = np.random.default_rng(seed).normal(size=(400, 3)) * 0.12
    check(vertices, triangles, points, share=0.9)
    inner = vertices.reshape(-1, 3, 3).mean(1)  # inside triangles, degenerate ones too
    check(vertices, triangles, np.concatenate([inner, vertices]), share=0.5)


def test_degenerate_triangles_are_never_chosen():
    """A collapsed edge must not answer distance 0 for everything near (or at all)."""
    vertices, triangles = grid_mesh(6, 0.0)
    extra = np.array([[0, 0, 0.01], [0, 0, 0.01], [0.01, 0, 0.01], [0.02, 0, 0.01]], np.float32)
    first = len(vertices)
    bad = [[first, first + 1, first + 2], [first, first, first], [first, first + 2, first + 3]]
    vertices = np.concatenate([vertices, extra])
    triangles = np.concatenate([np.array(bad, np.int32), triangles])
    points = np.random.default_rng(3).normal(size=(500, 3)) * 0.03
    _, (triangle, _, _), (expected, _, _) = ask(vertices, triangles, points)
    assert triangle.min() >= 3
    assert expected.min() >= 3
    check(vertices, triangles, points)
    assert not posed(CPU, vertices, triangles).usable[:3].any()


def test_a_triangle_that_degenerates_in_a_pose_comes_back():
    vertices, triangles = grid_mesh(5, 0.0)
    topology = CPU.Topology(torch.as_tensor(triangles), torch.as_tensor(vertices))
    point = torch.as_tensor(vertices[triangles[7]].mean(0)[None])
    flat = vertices.copy()
    flat[triangles[7, 1]] = flat[triangles[7, 0]]
    assert CPU.nearest(CPU.refit(topology, torch.as_tensor(flat)), point)[0] != 7
    assert CPU.nearest(CPU.refit(topology, torch.as_tensor(vertices)), point)[0] == 7


def test_ties_on_edges_and_vertices_go_to_the_lowest_index():
    vertices, triangles = grid_mesh(20, 0.003)
    rng = np.random.default_rng(4)
    order = rng.permutation(len(triangles))
    triangles = np.ascontiguousarray(triangles[order])
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1), axis=0)
    weight = rng.uniform(0.1, 0.9, (len(edges), 1)).astype(np.float32)
    on_edges = vertices[edges[:, 0]] * weight + vertices[edges[:, 1]] * (1 - weight)
    _, (at_vertex, _, distance), _ = ask(vertices, triangles, vertices)
    lowest = [int(np.nonzero((triangles == v).any(1))[0][0]) for v in range(len(vertices))]
    assert distance.max() < 1e-7
    # rounding may find a point beside the vertex or the edge
    assert np.mean(at_vertex.numpy() == lowest) > 0.95
    above = vertices + np.float32([0, 0, 0.5])  # sees vertices and edges of hills only
    _, (triangle, barycentric, _), _ = ask(vertices, triangles, above)
    alone = (barycentric == 1).any(1).numpy()
    assert alone.sum() > 5
    vertex = triangles[triangle.numpy(), barycentric.numpy().argmax(1)]
    assert np.array_equal(triangle.numpy()[alone], np.array(lowest)[vertex[alone]])
    _, (_, _, distance), _ = ask(vertices, triangles, on_edges)
    assert distance.max() < 1e-7


def test_copies_of_a_triangle_go_to_the_lowest_index():
    vertices, triangles = grid_mesh(6, 0.003)
    doubled = np.concatenate([triangles, triangles[:, [1, 2, 0]], triangles[:, [2, 1, 0]]])
    points = np.random.default_rng(5).normal(size=(300, 3)) * 0.05
    _, (triangle, _, _), _ = ask(vertices, doubled, points)
    assert triangle.max() < len(triangles)
    check(vertices, doubled, points)


def test_an_answer_does_not_depend_on_the_other_points(monkeypatch):
    vertices, triangles = grid_mesh(25, 0.004)
    mesh = posed(CPU, vertices, triangles)
    points = torch.as_tensor(
        np.random.default_rng(6).normal(size=(5000, 3)).astype(np.float32) * 0.06
    )
    answers = CPU.nearest(mesh, points)
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    monkeypatch.setenv("PAV_THREADS", "3")
    shuffled = CPU.nearest(mesh, points[order])
    for one, other in zip(answers, shuffled, strict=True):
        assert torch.equal(one[order], other)


def test_nothing_to_find():
    vertices, triangles = grid_mesh(4, 0.0)
    flat = np.zeros_like(vertices)
    broken = np.full_like(vertices, np.nan)
    empty = np.zeros((0, 3), np.int32)
    points = np.ones((5, 3), np.float32)
    for mesh in ((flat, triangles), (broken, triangles), (vertices, empty)):
        for triangle, barycentric, distance in ask(*mesh, points)[1:]:
            assert torch.all(triangle == -1)
            assert torch.all(barycentric == 0)
            assert torch.all(distance == torch.inf)
    for answer in ask(vertices, triangles, np.zeros((0, 3)))[1:]:
        assert all(len(values) == 0 for values in answer)


def test_points_and_vertices_that_are_not_finite():
    vertices, triangles = grid_mesh(8, 0.002)
    vertices[5] = np.nan
    vertices[20] = np.inf
    points = np.random.default_rng(7).normal(size=(200, 3)) * 0.1
    points[::9, 1] = np.nan
    points[4::31] = np.inf
    check(vertices, triangles, points)
    _, (triangle, _, _), _ = ask(vertices, triangles, points)
    assert torch.all(triangle[::9] == -1)
    assert (triangle >= 0).sum() > 150
    touched = np.nonzero(np.isin(triangles, [5, 20]).any(1))[0]
    assert not np.isin(triangle.numpy(), touched).any()


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_small_integer_meshes(data):
    """Coordinates on a tiny lattice: every kind of tie and degeneracy, exactly."""
    count = data.draw(st.integers(3, 9))
    places = data.draw(
        st.lists(st.tuples(*[st.integers(-2, 2)] * 3), min_size=count, max_size=count)
    )
    faces = st.tuples(*[st.integers(0, count - 1)] * 3)
    triangles = data.draw(st.lists(faces, min_size=1, max_size=20))
    points = data.draw(st.lists(st.tuples(*[st.integers(-5, 5)] * 3), min_size=1, max_size=20))
    vertices = np.array(places, np.float32) / 32
    check(vertices, np.array(triangles, np.int32), np.array(points, np.float32) / 64, share=0.0)


def test_the_reference_is_right():
    """Against a fine sampling of the triangle: the oracle's own check."""
    rng = np.random.default_rng(8)
    a, b, c = torch.as_tensor(rng.normal(size=(3, 1, 3)))
    points = torch.as_tensor(rng.normal(size=(50, 3)) * 2)
    _, squared = closest_on_triangle(points, a, b, c)
    u = np.linspace(0, 1, 200)
    weights = torch.as_tensor(np.array([(1 - p - q, p, q) for p in u for q in u if p + q <= 1]))
    cloud = weights @ torch.cat([a, b, c])
    sampled = torch.cdist(points, cloud).amin(1)
    exact = squared.sqrt()
    assert torch.all(sampled >= exact - 1e-9)
    assert torch.all(sampled <= exact + 0.02)
