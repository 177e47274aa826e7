"""Which samples are taken of a ray: every place is stood for, and the kernels agree."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_marching import CANONICAL, POSED, STEP, TRIANGLES, emitted, rays, run
from test_marching import shell as ball

from pav_blender.core.deformation import Clearance, Deformer, Thrift, clearance, voxels
from pav_blender.core.head import builtin_head
from pav_blender.core.kernels import select
from pav_blender.core.kernels.reference import picking as reference
from pav_blender.core.kernels.reference.marching import occupied

CPU = select("cpu").picking
BAND = 0.03
ALL = Thrift(width=200)  # every place is a sample


def posed(plain: bool = False, mode: str = "smooth"):
    return Deformer(CANONICAL, TRIANGLES, mode, reference=plain).pose(POSED)


def ranges(box: torch.Tensor, count: int, step: float):
    origins, directions, jitter = rays(count)
    marching = select("cpu").marching
    near, far = marching.bounds(box, 0.0, origins, directions)
    return origins, directions, *marching.lattice(near, far, jitter, step), jitter


def pick(
    kernels,
    guide: torch.Tensor,
    thrift: Thrift = ALL,
    space: Clearance | None = None,
    step: float = STEP,
    first: torch.Tensor | None = None,
    mode: str = "smooth",
):
    space = ball() if space is None else space
    found = voxels(posed(mode=mode), space, BAND)
    origins, directions, start, last, jitter = ranges(found.box, 48, step)
    chance = torch.rand(48, generator=torch.Generator().manual_seed(1))
    return kernels.pick(
        posed(kernels is reference, mode), found, guide, origins, directions,
        start if first is None else first, last, jitter, chance, torch.ones(48), step,
        clearance=space, band=BAND, thrift=thrift,
    )  # fmt: skip


def guide_of(kind: str) -> torch.Tensor:
    size = ball().grid.shape[0]
    empty = torch.full((size,) * 3, 1e-3)
    if kind == "empty":
        return empty
    if kind == "solid":
        return torch.where(ball().grid == 0, 1e4, 1e-3)
    noise = torch.rand((size,) * 3, generator=torch.Generator().manual_seed(2))
    return torch.exp(10 * noise - 4)


def used(picks) -> torch.Tensor:
    return torch.arange(picks.k.shape[1]) < picks.count[:, None]


def places(picks) -> set[tuple[int, int]]:
    ray, slot = used(picks).nonzero().unbind(1)
    return set(zip(ray.tolist(), picks.k[ray, slot].tolist(), strict=True))


TRAINING = Thrift(width=48, share=0.05, longest=3, opaque=8.0)
PICTURE = Thrift(width=6, share=0.02, longest=4)


@pytest.mark.parametrize("kind", ["empty", "noisy", "solid"])
@pytest.mark.parametrize("thrift", [ALL, TRAINING, PICTURE])
def test_the_kernel_picks_what_the_reference_picks(kind, thrift):
    got, want = (pick(kernels, guide_of(kind), thrift) for kernels in (CPU, reference))
    same = (got.count == want.count) & (got.looks == want.looks) & (got.next == want.next)
    assert same.float().mean() > 0.9  # a place on the edge of a voxel may differ
    alike = used(got) & same[:, None]
    for name in ("k", "steps"):
        equal = getattr(got, name) == getattr(want, name)
        assert equal[alike].float().mean() > 0.97
    both = alike & (got.k == want.k) & (got.triangle == want.triangle)
    assert both.sum() > 20
    torch.testing.assert_close(got.canonical[both], want.canonical[both], rtol=0, atol=2e-5)
    torch.testing.assert_close(got.distance[both], want.distance[both], rtol=0, atol=2e-6)


def everywhere() -> Clearance:
    return dataclasses.replace(ball(), grid=torch.zeros_like(ball().grid))


def test_samples_together_stand_for_every_place():
    got = pick(CPU, guide_of("empty"), TRAINING._replace(width=200), everywhere())
    inside = got.distance[used(got)] < 0.9 * BAND  # at the band's edge samples are dropped
    assert inside.float().mean() > 0.8
    assert got.steps[used(got)].max() == TRAINING.longest
    whole = pick(CPU, guide_of("empty"), ALL, everywhere())
    assert torch.equal(whole.looks, got.looks)
    dropped = got.looks - (got.steps * used(got)).sum(1)
    assert torch.all(dropped >= 0)
    assert dropped.sum() < 0.3 * got.looks.sum()
    assert torch.all((got.k[:, 1:] > got.k[:, :-1])[used(got)[:, 1:]])


def test_a_ray_ends_where_a_trusted_guide_is_opaque_and_says_so():
    space = ball()
    last = ranges(voxels(posed(), space, BAND).box, 48, STEP)[3]
    open_, solid = (pick(CPU, guide_of(kind), TRAINING) for kind in ("empty", "solid"))
    hit = solid.next <= last
    assert hit.sum() > 10
    assert torch.all(solid.looks[hit] < open_.looks[hit])
    assert torch.equal(solid.looks[~hit], open_.looks[~hit])
    assert torch.all(open_.next > last)
    final = solid.steps[hit, (solid.count[hit].long() - 1).clamp(min=0)]
    assert (final <= 1).float().mean() > 0.9  # a surface is not stepped over, but for its fringe
    untrusted = pick(CPU, guide_of("solid"), TRAINING._replace(opaque=math.inf))
    assert torch.equal(untrusted.looks, open_.looks)


def test_picking_continues_where_it_stopped():
    guide, thrift = guide_of("noisy"), Thrift(width=3)
    found, first = set(), None
    for _ in range(40):
        part = pick(CPU, guide, thrift, first=first)
        assert first is None or torch.all(part.next >= first)
        assert part.count.max() <= 3
        found |= places(part)
        first = part.next
    assert found == places(pick(CPU, guide))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 5), st.floats(0, 1e6, width=32)), max_size=30))
def test_the_guide_follows_alike_and_stays_between(seen):
    guides = [torch.full((2, 1, 3, 1), 0.5) for _ in range(2)]
    cells = torch.tensor([cell for cell, _ in seen], dtype=torch.int64)
    density = torch.tensor([value for _, value in seen], dtype=torch.float32)
    for kernels, guide in zip((CPU, reference), guides, strict=True):
        kernels.follow(guide, cells, density)
    torch.testing.assert_close(guides[0], guides[1], rtol=1e-4, atol=0)
    assert guides[0].min() >= min(0.5, reference.LEAST) * 0.999
    assert guides[0].max() <= max([0.5, *density.tolist()]) * 1.001


@pytest.mark.parametrize("mode", ["affine", "smooth"])
def test_voxels_hide_next_to_nothing(mode):
    space = ball()
    options = {"band": BAND, "clearance": space, "step": 0.001, "wave": 400, "leap_limit": 0.0}
    origins, directions, first, last, jitter = ranges(
        voxels(posed(mode=mode), space, BAND).box, 48, 0.001
    )
    marched = select("cpu").marching.march(
        posed(mode=mode), origins, directions, first, last, jitter, 0.001,
        wave=400, band=BAND, clearance=space, leap_limit=0.0,
    )  # fmt: skip
    everything = emitted(run(select("cpu").marching, posed(mode=mode), **options))
    want = emitted(marched)
    assert want == everything  # nothing lies outside the voxels' box
    got = places(pick(CPU, guide_of("empty"), Thrift(width=400), step=0.001, mode=mode))
    assert len(want) > 500
    assert got <= want
    assert len(want - got) <= 0.001 * len(want)


def test_voxels_are_tight_and_say_which_cell_they_are():
    space = ball()
    found = voxels(posed(), space, 0.05)
    low, high = found.box
    assert torch.all(low < posed().vertices.amin(0))
    assert torch.all(high > posed().vertices.amax(0))
    assert (high - low).max() < 0.4
    middle = ((torch.zeros(3) - low) * found.scale).long()
    assert found.bricks[tuple(middle.tolist())] < 0  # the ball is hollow
    filled = found.cells >= 0
    assert 0.2 < filled.float().mean() < 1
    near = space.grid.view(-1)[found.cells[filled].long()]
    assert near.max() == 1
    assert (near == 0).float().mean() > 0.4


def test_voxels_hide_little_where_a_turned_head_tears_space():
    """Something stands 4 to 10 cm off the neck, and the head turns: between skull and shoulders the
    nearest point leaps from one to the other."""
    head = builtin_head()
    canonical = head.canonical(np.zeros(0))
    pose = np.zeros((1, len(head.joint_names), 3))
    pose[0, head.joint_names.index("neck"), 1] = 0.6
    still = np.zeros((1, len(head.expression_names)))
    turned = head.pose(np.zeros(0), still, pose, np.zeros((1, 3)))[0].numpy()
    reach, count = 0.13, 128
    corner = torch.from_numpy((canonical.min(0) - reach).astype(np.float32))
    side = float(np.ptp(canonical, axis=0).max() + 2 * reach)
    middles = torch.cartesian_prod(*[(torch.arange(count) + 0.5) * side / count] * 3) + corner
    deformer = Deformer(canonical, head.triangles, "smooth")
    triangle, _, distance = deformer.nearest(deformer.pose(canonical), middles)
    neck = torch.tensor(head.regions["neck"])[deformer.triangles.long()[triangle.long()]].any(1)
    filled = (neck & (distance > 0.04) & (distance < 0.1)).view(count, count, count)
    space = Clearance(torch.from_numpy(clearance(filled.numpy())), corner, 1 / side)
    mesh = deformer.pose(turned)
    found = voxels(mesh, space, reach)
    place = (middles - found.box_min) * found.scale
    inside = ((place >= 0) & (place < len(found.bricks))).all(1)
    middles, place = middles[inside], place[inside]
    triangle, barycentric, distance = deformer.nearest(mesh, middles)
    there = select("cpu").marching.canonicalise(middles, triangle, barycentric, mesh)
    held = occupied(there, space) & (distance < reach)
    row = found.bricks[place.long().unbind(1)].long()
    within = ((place - place.floor()) * 4).long()
    cells = found.cells[row.clamp(min=0), within[:, 0], within[:, 1], within[:, 2]]
    missed = held & ((row < 0) | (cells < 0))
    assert held.sum() > 1000
    assert missed.sum() <= 0.001 * held.sum()  # 0.008 of them where torn bricks are left alone


def test_where_nothing_is_occupied_nothing_is_picked():
    space = ball(thickness=-1.0)
    assert len(voxels(posed(), space, BAND).cells) == 0
    for kernels in (CPU, reference):
        assert not places(pick(kernels, guide_of("empty"), ALL, space))
