"""Marching and compositing: the compiled kernels against the dense reference."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from pav_blender.core.deformation import Clearance, Deformer, clearance
from pav_blender.core.kernels import select

CPU, REFERENCE = select("cpu").marching, select("cpu", reference=True).marching
STEP = 0.004


def blob(rows: int = 13, columns: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """A closed ball of radius 10 cm, 2 rows * columns triangles."""
    theta = np.linspace(0, np.pi, rows + 2)[1:-1]
    phi = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    ring = np.stack([np.sin(t) * np.cos(p), np.cos(t), np.sin(t) * np.sin(p)], -1).reshape(-1, 3)
    vertices = np.concatenate([ring, [[0, 1, 0], [0, -1, 0]]]) * 0.1
    north, south = len(ring), len(ring) + 1
    triangles = []
    for j in range(columns):
        k = (j + 1) % columns
        triangles.append((north, k, j))
        last = (rows - 1) * columns
        triangles.append((south, last + j, last + k))
        for i in range(rows - 1):
            a, b = i * columns + j, i * columns + k
            triangles += [(a, b, a + columns), (b, b + columns, a + columns)]
    return vertices.astype(np.float32), np.array(triangles, np.int32)


CANONICAL, TRIANGLES = blob()
POSED = CANONICAL * np.float32([1.15, 0.9, 1.0]) + np.float32(0.008) * np.sin(
    30 * CANONICAL[:, [1, 2, 0]]
)


def shell(size: int = 48, thickness: float = 0.007) -> Clearance:
    """Cells of the canonical cube that lie close to the ball's surface."""
    side = 0.32
    centres = (np.indices((size,) * 3).reshape(3, -1).T + 0.5) / size * side - side / 2
    near = np.abs(np.linalg.norm(centres, axis=1) - 0.1) < thickness
    grid = clearance(near.reshape(size, size, size))
    return Clearance(torch.as_tensor(grid), torch.full((3,), -side / 2), 1 / side)


def rays(count: int = 48, seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    spread = torch.rand((count, 2), generator=generator) * 0.3 - 0.15
    directions = torch.cat([spread, -torch.full((count, 1), 0.5)], 1)
    origins = torch.tensor([0.0, 0.0, 0.5]).expand(count, 3).contiguous()
    return (
        origins,
        torch.nn.functional.normalize(directions, dim=1),
        torch.rand(count, generator=generator),
    )


def both(mode: str):
    pair = []
    for reference, kernels in ((False, CPU), (True, REFERENCE)):
        deformer = Deformer(CANONICAL, TRIANGLES, mode, reference=reference)
        pair.append((kernels, deformer.pose(POSED)))
    return pair


def run(kernels, mesh, wave=80, margin=0.03, step=STEP, count=48, **options):
    origins, directions, jitter = rays(count)
    near, far = kernels.bounds(mesh.vertices, margin, origins, directions)
    first, last = kernels.lattice(near, far, jitter, step)
    return kernels.march(mesh, origins, directions, first, last, jitter, step, wave=wave, **options)


def emitted(wave) -> set[tuple[int, int]]:
    ray, slot = torch.nonzero(wave.k >= 0, as_tuple=True)
    return set(zip(ray.tolist(), wave.k[ray, slot].tolist(), strict=True))


@pytest.mark.parametrize("mode", ["rigid", "affine", "smooth"])
@pytest.mark.parametrize("wave", [3, 80])
@pytest.mark.parametrize("kind", ["dense", "band", "clearance"])
def test_march_matches_the_reference_where_nothing_is_leapt(mode, wave, kind):
    options = {
        "dense": {},
        "band": {"band": 0.01},
        "clearance": {"band": 0.03, "clearance": shell(), "leap_limit": 0.0},
    }[kind]
    got, want = (run(kernels, mesh, wave, **options) for kernels, mesh in both(mode))
    assert want.count.sum() > 50
    same = (got.k == want.k).all(1)
    assert same.float().mean() > 0.95  # a sample on the very edge of band or cell may differ
    assert torch.equal(got.count[same], want.count[same])
    assert torch.equal(got.next[same], want.next[same])
    alike = same[:, None] & (got.triangle == want.triangle)
    assert alike.float().mean() > 0.93
    torch.testing.assert_close(got.distance[same], want.distance[same], rtol=1e-5, atol=1e-7)
    for name, tight, loose in (("barycentric", 2e-5, 3e-3), ("canonical", 1e-6, 2e-5)):
        error = (getattr(got, name)[alike] - getattr(want, name)[alike]).abs()
        assert torch.quantile(error, 0.99) < tight
        assert error.max() < loose  # far away, float32 wavers between two edges of a triangle


@pytest.mark.parametrize("step", [5e-5, 1e-3])
@pytest.mark.parametrize("away", [0.0, 0.4, 20.0])
def test_rays_straight_at_the_mesh_are_followed_to_their_end(away, step):
    """The nearest point of one place bounds the search of the next: here it is the nearest point
    of all places, so that nothing but rounding lies between that bound and the answer."""
    vertices = POSED + np.float32(away)
    mesh = Deformer(CANONICAL, TRIANGLES, "rigid").pose(vertices)
    corners = torch.from_numpy(vertices)[torch.from_numpy(TRIANGLES).long()]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    directions = torch.nn.functional.normalize(normals, dim=1)  # towards the inside
    origins = corners.mean(1) - 0.02 * directions
    count = len(origins)
    first = torch.zeros(count, dtype=torch.int32)
    last = torch.full((count,), round(0.024 / step), dtype=torch.int32)
    wave = CPU.march(
        mesh, origins, directions, first, last, torch.zeros(count), step,
        wave=int(last[0]) + 1, band=0.03,
    )  # fmt: skip
    assert torch.equal(wave.count, last + 1)


@pytest.mark.parametrize("mode", ["affine", "smooth"])
def test_leaps_pass_over_next_to_nothing(mode):
    (kernels, mesh), (reference, dense) = both(mode)
    options = {"band": 0.03, "clearance": shell(), "step": 0.001}
    got = emitted(run(kernels, mesh, wave=200, **options))
    want = emitted(run(reference, dense, wave=200, **options))
    assert len(want) > 500
    assert len(want - got) <= 0.002 * len(want)
    assert len(got - want) <= 0.002 * len(want)


def test_waves_continue_where_the_last_one_stopped():
    kernels, mesh = both("affine")[0]
    options = {"clearance": shell(), "band": 0.03}
    whole = run(kernels, mesh, wave=80, **options)
    origins, directions, jitter = rays()
    near, far = kernels.bounds(mesh.vertices, 0.03, origins, directions)
    first, last = kernels.lattice(near, far, jitter, STEP)
    found: set[tuple[int, int]] = set()
    for _ in range(40):
        part = kernels.march(
            mesh, origins, directions, first, last, jitter, STEP, wave=3, **options
        )
        assert torch.all(part.next > first - 1)
        found |= emitted(part)
        first = part.next
        if torch.all(first > last):
            break
    assert torch.equal(first, torch.maximum(first, last + 1))
    assert found == emitted(whole)


def test_rays_that_have_nothing_to_do():
    for kernels, mesh in both("affine"):
        origins, directions, jitter = rays(20)
        first = torch.arange(20, dtype=torch.int32)
        last = first - 1
        wave = kernels.march(mesh, origins, directions, first, last, jitter, STEP, wave=2)
        assert torch.all(wave.count == 0)
        assert torch.equal(wave.next, first)
        assert torch.all(wave.k == -1)
        assert torch.all(wave.canonical == 0)
        none = torch.zeros(0, dtype=torch.int32)
        wave = kernels.march(
            mesh, origins[:0], directions[:0], none, none, jitter[:0], STEP, wave=2
        )
        assert wave.k.shape == (0, 2)


def test_a_mesh_of_degenerate_triangles_ends_every_ray():
    for reference in (False, True):
        deformer = Deformer(CANONICAL, TRIANGLES, "affine", reference=reference)
        mesh = deformer.pose(np.zeros_like(CANONICAL))
        wave = run(deformer.kernels.marching, mesh, margin=0.05)
        assert torch.all(wave.count == 0)
        assert torch.all(wave.triangle == -1)


def test_nothing_is_occupied_outside_the_box():
    kernels, mesh = both("affine")[0]
    full = dataclasses.replace(shell(), grid=torch.zeros((8, 8, 8), dtype=torch.uint8))
    half = dataclasses.replace(full, box_min=torch.zeros(3))
    everything = emitted(run(kernels, mesh, clearance=full, band=0.02))
    assert everything == emitted(run(kernels, mesh, band=0.02))
    reference, dense = both("affine")[1]
    part = emitted(run(kernels, mesh, clearance=half, band=0.02, leap_limit=0.0))
    assert part == emitted(run(reference, dense, clearance=half, band=0.02))
    assert 0 < len(part) < len(everything)


def test_bounds_against_points_along_the_rays():
    vertices = torch.as_tensor(CANONICAL)
    generator = torch.Generator().manual_seed(1)
    origins = torch.randn((300, 3), generator=generator) * 0.3
    directions = torch.randn((300, 3), generator=generator)
    directions[::5, 0] = 0.0
    directions[1::7, 1:] = 0.0
    directions = torch.nn.functional.normalize(directions, dim=1)
    near, far = CPU.bounds(vertices, 0.02, origins, directions)
    t = torch.linspace(0, 2, 400)
    points = origins[:, None] + t[:, None] * directions[:, None]
    low, high = vertices.amin(0) - 0.02, vertices.amax(0) + 0.02
    inside = ((points >= low) & (points <= high)).all(-1)
    reached = (t >= near[:, None] - 1e-5) & (t <= far[:, None] + 1e-5)
    assert torch.all(reached[inside])
    deep = (t >= near[:, None] + 1e-5) & (t <= far[:, None] - 1e-5)
    assert torch.all(inside[deep])
    assert 0 < (far < near).sum() < 300


def test_lattice_holds_the_indices_within():
    near = torch.tensor([0.1, 0.0, 0.0, 0.1])
    far = torch.tensor([0.2, 0.011, -1.0, 0.1001])
    jitter = torch.tensor([0.5, 0.0, 0.5, 0.5])
    first, last = CPU.lattice(near, far, jitter, 0.01)
    assert first.tolist() == [10, 0, 0, 10]
    assert last.tolist() == [19, 1, -1, 9]


def packed(count=400, rays=40, seed=0, scale=300.0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    index = torch.randint(0, rays, (count,), generator=generator)
    index[index == 7] = 8  # a ray without samples
    index = index.sort().values.int()
    sigma = torch.rand(count, generator=generator, dtype=dtype) * scale
    rgb = torch.rand((count, 3), generator=generator, dtype=dtype)
    t = torch.rand(count, generator=generator, dtype=dtype)
    return sigma, rgb, t, index


@pytest.mark.parametrize("scale", [0.0, 30.0, 3e3, 1e12])
@pytest.mark.parametrize("varying", [False, True])
def test_composite_matches_float64_in_values_and_gradients(scale, varying):
    sigma, rgb, t, index = packed(scale=scale)
    generator = torch.Generator().manual_seed(5)
    delta = torch.rand(len(sigma), generator=generator) * 0.01 if varying else 0.003
    upstream = [torch.rand(shape, generator=generator) for shape in ((40, 3), 40, 40, 400)]
    results = []
    for kernels, kind in ((CPU, torch.float32), (REFERENCE, torch.float64)):
        inputs = [x.to(kind).requires_grad_() for x in (sigma, rgb, t)]
        width = delta.to(kind) if varying else delta
        values = kernels.composite(*inputs, width, index, 40)
        total = sum((a * b.to(kind)).sum() for a, b in zip(values, upstream, strict=True))
        results.append([*values, *torch.autograd.grad(total, inputs)])
    for got, want in zip(*results, strict=True):
        assert got.isfinite().all()
        torch.testing.assert_close(got.double(), want, rtol=3e-5, atol=2e-7)


def test_composite_by_hand():
    sigma = torch.tensor([100.0, 200.0])
    rgb = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    index = torch.tensor([1, 1], dtype=torch.int32)
    a, b = 1 - np.exp(-1), 1 - np.exp(-2)
    for kernels in (CPU, REFERENCE):
        colour, opacity, depth, weights = kernels.composite(
            sigma, rgb, torch.tensor([2.0, 3.0]), 0.01, index, 2
        )
        expected = torch.tensor([a, (1 - a) * b], dtype=torch.float32)
        torch.testing.assert_close(weights, expected)
        torch.testing.assert_close(colour[1], torch.tensor([*expected.tolist(), 0.0]))
        torch.testing.assert_close(opacity, torch.tensor([0.0, float(expected.sum())]))
        torch.testing.assert_close(depth[1], 2 * expected[0] + 3 * expected[1])


@pytest.mark.parametrize("kernels", [CPU, REFERENCE])
def test_waves_of_weights_are_those_of_the_whole(kernels):
    sigma, rgb, t, index = packed()
    whole = kernels.composite(sigma, rgb, t, 0.003, index, 40)
    left = torch.ones(40)
    start = torch.searchsorted(index.long(), torch.arange(40))
    place = torch.arange(len(index)) - start[index.long()]
    weights = torch.zeros(len(index))
    for low in range(0, 40, 4):
        part = (place >= low) & (place < low + 4)
        weights[part] = kernels.weigh(sigma[part], 0.003, index[part], left)
    torch.testing.assert_close(weights, whole[3], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(left, 1 - whole[1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kernels", [CPU, REFERENCE])
def test_no_samples_at_all(kernels):
    sigma, rgb, t = torch.zeros(0, requires_grad=True), torch.zeros(0, 3), torch.zeros(0)
    index = torch.zeros(0, dtype=torch.int32)
    colour, opacity, _, _ = kernels.composite(sigma, rgb, t, 0.01, index, 5)
    (colour.sum() + opacity.sum()).backward()
    assert torch.all(colour == 0)
    assert sigma.grad.shape == (0,)


def test_what_cannot_be_composited_is_refused():
    sigma, rgb, t, index = packed()
    with pytest.raises(ValueError, match="sorted"):
        CPU.composite(sigma, rgb, t, 0.01, index.flip(0), 40)
    with pytest.raises(ValueError, match="within"):
        CPU.composite(sigma, rgb, t, 0.01, index, 20)
