"""Cubes of posed space: the compiled kernels agree with plain torch, and nothing is overlooked."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_marching import CANONICAL, POSED, TRIANGLES
from test_marching import shell as ball

from pav_blender.core.deformation import Clearance, Deformer, clearance, voxels
from pav_blender.core.head import builtin_head
from pav_blender.core.kernels import select
from pav_blender.core.kernels.reference import bricks as reference
from pav_blender.core.kernels.reference import frames
from pav_blender.core.kernels.reference.bricks import Found

CPU = select("cpu").bricks
SIDE = 0.012
MODES = ["affine", "smooth"]


def posed(plain: bool = False, mode: str = "smooth"):
    return Deformer(CANONICAL, TRIANGLES, mode, reference=plain).pose(POSED)


def points(count: int = 500) -> torch.Tensor:
    return torch.rand((count, 3), generator=torch.Generator().manual_seed(1)) * 0.3 - 0.15


def looks(mode: str, near: float = 0.05, feet: torch.Tensor | None = None):
    feet = torch.full((500, 3), torch.inf) if feet is None else feet
    return [
        k.look(posed(k is reference, mode), ball(), points(), near, 3, feet)
        for k in (CPU, reference)
    ]


@pytest.mark.parametrize("mode", MODES)
def test_looks_as_the_reference(mode):
    got, want = looks(mode)
    assert 50 < want.kept.sum() < 450
    assert (got.kept == want.kept).float().mean() > 0.99
    both = got.kept & want.kept
    assert torch.equal(got.triangle[both], want.triangle[both])
    torch.testing.assert_close(got.foot[both], want.foot[both], rtol=0, atol=2e-6)
    torch.testing.assert_close(got.canonical[both], want.canonical[both], rtol=0, atol=2e-6)
    assert (got.clear[both] == want.clear[both]).float().mean() > 0.99


def test_where_a_look_begins_changes_nothing():
    vertices = torch.as_tensor(POSED).float()
    feet = vertices[torch.arange(500) % len(vertices)].clone()
    feet[::7] = torch.inf
    usual = looks("smooth")[0]
    for got, want in zip(looks("smooth", feet=feet)[0], usual, strict=True):
        assert torch.equal(got[usual.kept], want[usual.kept])


@pytest.mark.parametrize("mode", MODES)
def test_maps_as_the_reference_and_they_lead_to_the_canonical_place(mode):
    found = looks(mode)[1]
    kept = found.kept.nonzero()[:, 0]
    found, middles = found.pick(kept), points()[kept]
    got, want = (
        k.brick_maps(posed(k is reference, mode), found, middles) for k in (CPU, reference)
    )
    torch.testing.assert_close(got, want, rtol=0, atol=1e-5)
    maps = got[:, :12].view(-1, 3, 4)
    there = (maps[:, :, :3] @ middles[..., None])[..., 0] + maps[:, :, 3]
    torch.testing.assert_close(there, found.canonical, rtol=0, atol=1e-6)


def found_at(canonical: torch.Tensor, clear: float = 0.0) -> Found:
    nothing = torch.zeros(len(canonical))
    return Found(nothing, nothing, nothing, nothing, canonical, torch.full_like(nothing, clear))


def rows_of(linear: torch.Tensor) -> torch.Tensor:
    """Maps of which only the linear part counts."""
    moved = torch.zeros(len(linear), 3, 1)
    return torch.nn.functional.pad(torch.cat([linear, moved], 2).view(-1, 12), (0, 4))


def test_cells_as_the_reference():
    generator = torch.Generator().manual_seed(3)
    middles = torch.rand((200, 3), generator=generator) * 0.4 - 0.2  # some outside the box
    maps = rows_of(torch.eye(3) + 0.3 * torch.randn((200, 3, 3), generator=generator))
    found, rows = found_at(middles, 5.0), torch.arange(199, -1, -2)
    got, want = (k.brick_cells(rows, found, maps, ball(), 0.003, 5) for k in (CPU, reference))
    assert (got == want).float().mean() > 0.999
    assert 0.05 < (want >= 0).float().mean() < 0.9
    for kernels in (CPU, reference):
        assert (kernels.brick_cells(rows, found, maps, ball(), 0.003, 4) < 0).all()


def seam():
    """Two halves whose maps have nothing to do with one another."""
    generator = torch.Generator().manual_seed(4)
    where = torch.cartesian_prod(*[torch.arange(8)] * 3).int() + 1
    at = torch.full((10, 10, 10), -1, dtype=torch.int32)
    at[where.long().unbind(1)] = torch.arange(512, dtype=torch.int32)
    middles = where * SIDE - 0.05
    far = middles + torch.tensor([0.0, 0.09, 0.0])
    canonical = torch.where(where[:, :1] <= 4, middles, far)
    maps = torch.eye(3).repeat(512, 1, 1) + 0.01 * torch.randn((512, 3, 3), generator=generator)
    return at, where, canonical, rows_of(maps)


def test_torn_bricks_as_the_reference_take_their_neighbours_cells():
    """The seam belongs to both halves."""
    at, where, canonical, maps = seam()
    filled, rows = [], torch.arange(511, -1, -1)[:500]
    where_of = where[rows]
    for kernels in (CPU, reference):
        cells = kernels.brick_cells(rows, found_at(canonical), maps, ball(), 0.003, 5)
        own = cells.clone()
        kernels.add_torn(cells, rows, at, where, canonical, maps, ball(), 0.003, 5)
        changed = (cells != own).any(1)
        assert (own[changed] < 0).any()
        assert torch.equal(cells[own >= 0], own[own >= 0])  # what was known stays
        assert set(where_of[changed][:, 0].tolist()) <= {4, 5}  # the seam alone
        filled.append(cells)
    assert (filled[0] == filled[1]).float().mean() > 0.999


def test_leaps_as_the_reference():
    at, where, canonical, maps = seam()
    leaps = [k.leaps(at, where, canonical, maps, SIDE) for k in (CPU, reference)]
    torch.testing.assert_close(*leaps, rtol=0, atol=1e-6)
    torn = (where[:, 0] == 4) | (where[:, 0] == 5)
    assert leaps[0][torn].min() > 0.08
    assert leaps[0][~torn].max() < 0.004


def test_likely_parts_as_the_reference():
    at, where, canonical, maps = seam()
    leaps = CPU.leaps(at, where, canonical, maps, SIDE)
    got, want = (k.likely(canonical, maps, leaps, ball(), SIDE, 1) for k in (CPU, reference))
    assert (got == want).float().mean() > 0.999
    torn = leaps > reference.FAR
    assert got[torn].all()
    assert 0.1 < got[~torn].float().mean() < 0.9


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_what_a_cubes_map_rules_out_holds_nothing(turn, monkeypatch):
    """The same voxels as where every part of a cube is looked at, but for one in a thousand."""
    head = builtin_head()
    canonical = head.canonical(np.zeros(0))
    pose = np.zeros((1, len(head.joint_names), 3))
    pose[0, head.joint_names.index("neck"), 1] = turn
    pose[0, head.joint_names.index("jaw"), 0] = turn / 2
    still = np.zeros((1, len(head.expression_names)))
    vertices = head.pose(np.zeros(0), still, pose, np.zeros((1, 3)))[0].numpy()
    deformer, reach, size = Deformer(canonical, head.triangles, "smooth"), 0.08, 64
    corner = torch.from_numpy((canonical.min(0) - reach).astype(np.float32))
    side = float(np.ptp(canonical, axis=0).max() + 2 * reach)
    middles = torch.cartesian_prod(*[(torch.arange(size) + 0.5) * side / size] * 3) + corner
    distance = deformer.nearest(deformer.pose(canonical), middles)[2].view(size, size, size)
    hair = (distance < 0.01) | ((distance > 0.03) & (distance < 0.04))
    space = Clearance(torch.from_numpy(clearance(hair.numpy())), corner, 1 / side)
    mesh = deformer.pose(vertices)
    few = voxels(mesh, space, reach)
    asked = []

    def all_of_them(canonical, *_):
        asked.append(len(canonical))
        return torch.ones(len(canonical), 8, dtype=torch.bool)

    monkeypatch.setattr(CPU, "likely", all_of_them)
    every = voxels(mesh, space, reach)
    assert len(asked) == 2
    assert len(every.cells) > 2000
    assert (few.cells >= 0).sum() >= 0.999 * (every.cells >= 0).sum()


def test_vertex_maps_as_the_reference():
    canonical = torch.as_tensor(CANONICAL).float()
    turned, triangles = torch.as_tensor(POSED).float(), torch.as_tensor(np.array(TRIANGLES))
    flat = triangles.int().clone()
    flat[3, 1] = flat[3, 0]  # a degenerate triangle
    loose = len(canonical)  # and a vertex without any
    canonical, turned = (torch.cat([mesh, mesh[:1]]) for mesh in (canonical, turned))
    got = select("cpu").frames.vertex_maps(canonical, turned, flat)
    want = frames.vertex_maps(canonical, turned, flat)
    torch.testing.assert_close(got, want, rtol=0, atol=2e-6)
    torch.testing.assert_close(got[loose, :, :3], torch.eye(3))
