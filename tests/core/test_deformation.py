"""Maps to canonical space: exact where they must be, finite everywhere, and how smooth."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pav_blender.core.deformation import Deformer, canonicalise, clearance, triangle_maps
from pav_blender.core.deformation.rigid import stance
from pav_blender.core.errors import InputError
from pav_blender.core.kernels import select

MODES = ("rigid", "affine", "smooth")


def sheet(size: int = 12) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.linspace(-0.1, 0.1, size), np.linspace(-0.1, 0.1, size))
    vertices = np.stack([u, v, 0.3 * (u**2 - v**2) * 10], -1).reshape(-1, 3)
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + size], 1)
    upper = np.stack([corner + 1, corner + size + 1, corner + size], 1)
    return vertices.astype(np.float32), np.concatenate([lower, upper]).astype(np.int32)


CANONICAL, TRIANGLES = sheet()
BENT = CANONICAL * np.float32([1.2, 0.85, 1.0]) + np.float32(0.006) * np.sin(
    25 * CANONICAL[:, [1, 2, 0]]
)


def carry(mode, posed, points, reference=False):
    deformer = Deformer(CANONICAL, TRIANGLES, mode, reference=reference)
    mesh = deformer.pose(posed)
    triangle, barycentric, distance = deformer.nearest(mesh, points)
    return deformer.kernels.marching.canonicalise(points, triangle, barycentric, mesh), distance


def scattered(count: int = 500, spread: float = 0.08) -> torch.Tensor:
    return torch.as_tensor(
        np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32) * spread
    )


@pytest.mark.parametrize("mode", MODES)
def test_at_rest_nothing_moves(mode):
    points = scattered()
    moved, _ = carry(mode, CANONICAL, points)
    torch.testing.assert_close(moved, points, rtol=0, atol=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_a_rigid_motion_is_undone(mode):
    turn = Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix()
    shift = np.array([0.1, -0.2, 0.3])
    points = scattered()
    away = torch.as_tensor((points.numpy() @ turn.T + shift).astype(np.float32))
    moved, _ = carry(mode, (CANONICAL @ turn.T + shift).astype(np.float32), away)
    torch.testing.assert_close(moved, points, rtol=0, atol=3e-6)


@pytest.mark.parametrize("mode", ["affine", "smooth"])
def test_the_surface_goes_to_the_same_place_on_the_canonical_surface(mode):
    weights = torch.as_tensor(
        np.random.default_rng(1).dirichlet([1, 1, 1], len(TRIANGLES)).astype(np.float32)
    )
    at = (torch.as_tensor(BENT[TRIANGLES]) * weights[..., None]).sum(1)
    want = (torch.as_tensor(CANONICAL[TRIANGLES]) * weights[..., None]).sum(1)
    moved, distance = carry(mode, BENT, at)
    assert distance.max() < 1e-6
    torch.testing.assert_close(moved, want, rtol=0, atol=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_compiled_and_reference_maps_agree(mode):
    points = scattered()
    got, want = (carry(mode, BENT, points, reference)[0] for reference in (False, True))
    # nearest triangles differ in ties, where only "smooth" maps both alike
    close = (got - want).norm(dim=1) < 2e-6
    assert close.float().mean() > (0.995 if mode == "smooth" else 0.9)


def jumps(mode: str, height: float) -> np.ndarray:
    """The largest distance between images of neighbours 5 um apart, on paths across edges [E]."""
    rng = np.random.default_rng(2)
    edges = np.unique(np.sort(TRIANGLES[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1), axis=0)
    weight = rng.uniform(0.2, 0.8, (len(edges), 1))
    at = BENT[edges[:, 0]] * weight + BENT[edges[:, 1]] * (1 - weight)
    along = BENT[edges[:, 1]] - BENT[edges[:, 0]]
    up = np.cross(np.cross(along, [0, 0, 1.0]), along)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    side = np.cross(up, along)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    path = np.linspace(-5e-4, 5e-4, 201)
    points = (at + height * up)[:, None] + path[:, None] * side[:, None]
    images, _ = carry(mode, BENT, torch.as_tensor(points.reshape(-1, 3).astype(np.float32)))
    steps = np.diff(images.numpy().reshape(points.shape), axis=1)
    return np.linalg.norm(steps, axis=-1).max(1)


def test_continuity_across_edges():
    """What the modes are for: rigid frames tear the surface, affine ones only what is off it."""
    path = 1.5e-5  # what 5 um become under any stretch there is
    assert np.percentile(jumps("rigid", 0.0), 90) > 1e-4
    assert jumps("affine", 0.0).max() < path
    assert np.percentile(jumps("affine", 0.004), 90) > 5e-5
    assert jumps("smooth", 0.0).max() < path
    assert np.percentile(jumps("smooth", 0.004), 99) < path


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("where", ["posed", "canonical", "both"])
def test_degenerate_triangles_give_finite_maps(mode, where):
    bad = TRIANGLES.copy()
    bad[3] = [5, 5, 9]
    collapsed = BENT.copy()
    collapsed[TRIANGLES[40, 1]] = collapsed[TRIANGLES[40, 0]]
    collapsed[TRIANGLES[80]] = collapsed[TRIANGLES[80, 0]]
    canonical = CANONICAL if where == "posed" else collapsed
    posed = BENT if where == "canonical" else collapsed
    for reference in (False, True):
        deformer = Deformer(canonical, bad, mode, reference=reference)
        mesh = deformer.pose(posed)
        maps = mesh.vertex_maps if mode == "smooth" else mesh.triangle_maps
        assert maps.isfinite().all()
        assert maps.abs().max() < 1e5
        points = scattered()
        moved = canonicalise(points, *deformer.nearest(mesh, points)[:2], mesh)
        assert moved.isfinite().all()


def test_a_degenerate_triangle_is_moved_and_not_turned():
    canonical = torch.as_tensor(CANONICAL)
    posed = torch.as_tensor(BENT).clone()
    a, b, _ = TRIANGLES[40]
    posed[b] = posed[a]
    for mode in ("rigid", "affine"):
        found = triangle_maps(canonical, posed, torch.as_tensor(TRIANGLES), mode)[40]
        torch.testing.assert_close(found[:, :3], torch.eye(3))
        corners = torch.as_tensor(TRIANGLES[40]).long()
        shift = canonical[corners].mean(0) - posed[corners].mean(0)
        torch.testing.assert_close(found[:, 3], shift)


@pytest.mark.parametrize("mode", ["rigid", "affine"])
def test_batches_of_poses(mode):
    canonical, triangles = torch.as_tensor(CANONICAL), torch.as_tensor(TRIANGLES)
    poses = torch.stack([torch.as_tensor(BENT), canonical])
    together = triangle_maps(canonical, poses, triangles, mode)
    for pose, maps in zip(poses, together, strict=True):
        torch.testing.assert_close(triangle_maps(canonical, pose, triangles, mode), maps)


def test_points_without_a_triangle_stay():
    deformer = Deformer(CANONICAL, TRIANGLES, "affine")
    mesh = deformer.pose(BENT)
    points = scattered(5)
    nowhere = torch.full((5,), -1, dtype=torch.int32)
    for reference in (False, True):
        kernels = select("cpu", reference=reference)
        moved = kernels.marching.canonicalise(points, nowhere, torch.zeros(5, 3), mesh)
        assert torch.equal(moved, points)


def test_wrong_input_is_named():
    with pytest.raises(InputError, match="none of"):
        Deformer(CANONICAL, TRIANGLES, "loose")
    with pytest.raises(InputError, match="same mesh"):
        Deformer(CANONICAL, TRIANGLES).pose(CANONICAL[:-1])
    with pytest.raises(InputError, match="outside"):
        Deformer(CANONICAL[:-1], TRIANGLES)


@pytest.mark.parametrize("seed", range(3))
def test_clearance_counts_cells(seed):
    occupied = np.random.default_rng(seed).random((9, 9, 9)) < 0.01
    occupied[1, 2, 3] = True
    filled = np.argwhere(occupied)
    cells = np.argwhere(np.ones_like(occupied))
    want = np.abs(cells[:, None] - filled).max(-1).min(1).reshape(occupied.shape)
    found = clearance(occupied)
    assert found.dtype == np.uint8
    assert np.array_equal(found, want)


def test_clearance_of_nothing_and_of_much():
    assert np.all(clearance(np.zeros((4, 4, 4), bool)) == 255)
    assert np.all(clearance(np.ones((4, 4, 4), bool)) == 0)
    long = np.zeros((300, 1, 1), bool)
    long[0] = True
    assert clearance(long)[-1, 0, 0] == 255


def test_the_heads_turn_is_against_the_shoulders_wherever_all_of_it_goes():
    rng = np.random.default_rng(0)
    skull = rng.normal((0, 0.3, 0), 0.08, (60, 3))
    shoulders = rng.normal((0, -0.3, 0), 0.1, (40, 3))
    canonical = np.concatenate([skull, shoulders]).astype(np.float32)
    weights = np.repeat(np.float32([1, 0]), [60, 40])
    angle = 0.3
    about_y = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    posed = np.concatenate([skull @ about_y.T, shoulders])
    everywhere, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    everywhere *= np.sign(np.linalg.det(everywhere))
    for rotation, shift in ((np.eye(3), 0.0), (everywhere, 0.4)):
        moved = (posed @ rotation.T + shift).astype(np.float32)
        found = stance(canonical, moved, weights)
        np.testing.assert_allclose(found.turn, [0, np.sin(angle), 0], atol=1e-5)
        still = found.still(torch.from_numpy(moved)).numpy()
        np.testing.assert_allclose(still[60:], canonical[60:], atol=1e-5)
        assert np.abs(still[:60] - canonical[:60]).max() > 0.02
