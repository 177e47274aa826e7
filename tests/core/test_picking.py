"""Which samples training takes: every place is stood for, and the kernels agree."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_marching import CANONICAL, POSED, STEP, TRIANGLES, emitted, rays, run
from test_marching import shell as ball

from pav_blender.core.deformation import Deformer, box, shell
from pav_blender.core.kernels import select
from pav_blender.core.kernels.reference import picking as reference

CPU = select("cpu").picking


def pick(kernels, guide: torch.Tensor, count: int = 48, step: float = STEP):
    plain = kernels is reference
    mesh = Deformer(CANONICAL, TRIANGLES, "smooth", reference=plain).pose(POSED)
    marching = select("cpu", reference=plain).marching
    origins, directions, jitter = rays(count)
    near, far = marching.bounds(mesh.vertices, 0.03, origins, directions)
    first, last = marching.lattice(near, far, jitter, step)
    chance = torch.rand(count, generator=torch.Generator().manual_seed(1))
    options = {"clearance": ball(), "guide": guide, "band": 0.03, "leap_limit": 0.0}
    args = mesh, origins, directions, first, last, jitter
    return kernels.pick(*args, chance, step, **options)


def guide_of(kind: str) -> torch.Tensor:
    size = ball().grid.shape[0]
    empty = torch.full((size,) * 3, 1e-3)
    if kind == "empty":
        return empty
    if kind == "solid":
        return torch.full((size,) * 3, 1e4)
    noise = torch.rand((size,) * 3, generator=torch.Generator().manual_seed(2))
    return torch.exp(10 * noise - 4)


@pytest.mark.parametrize("kind", ["empty", "noisy", "solid"])
def test_the_kernel_picks_what_the_reference_picks(kind):
    got, want = (pick(kernels, guide_of(kind)) for kernels in (CPU, reference))
    same = (got.count == want.count) & (got.looks == want.looks) & (got.ended == want.ended)
    assert same.float().mean() > 0.9  # a sample on the edge of a cell may differ
    used = torch.arange(got.k.shape[1]) < got.count[:, None]
    alike = used & same[:, None]
    for name in ("k", "steps"):
        equal = getattr(got, name) == getattr(want, name)
        assert equal[alike].float().mean() > 0.97
    both = alike & (got.k == want.k) & (got.triangle == want.triangle)
    assert both.sum() > 20
    torch.testing.assert_close(got.canonical[both], want.canonical[both], rtol=0, atol=2e-5)


def test_samples_together_stand_for_every_place():
    got = pick(CPU, guide_of("empty"))
    used = torch.arange(got.k.shape[1]) < got.count[:, None]
    assert torch.equal((got.steps * used).sum(1).int(), got.looks)
    assert got.steps[used].max() == reference.LONGEST
    assert not got.ended.any()
    following = used[:, 1:]
    assert torch.all((got.k[:, 1:] > got.k[:, :-1])[following])


def test_a_ray_ends_where_the_guide_is_opaque_and_says_so():
    open_, solid = pick(CPU, guide_of("empty")), pick(CPU, guide_of("solid"))
    hit = open_.looks > 2
    assert hit.sum() > 10
    assert torch.all(solid.looks[hit] < open_.looks[hit])
    assert torch.all(solid.ended[hit])
    used = torch.arange(solid.k.shape[1]) < solid.count[:, None]
    assert torch.all(solid.steps[used] == 1)  # a surface is not stepped over


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
def test_a_shell_hides_next_to_nothing(mode):
    mesh = Deformer(CANONICAL, TRIANGLES, mode).pose(POSED)
    space = ball()
    kernels = select("cpu").marching
    options = {"band": 0.03, "clearance": space, "step": 0.001, "wave": 200, "leap_limit": 0.0}
    want = emitted(run(kernels, mesh, **options))
    got = emitted(run(kernels, mesh, **options, shell=shell(mesh, space, 0.03)))
    assert len(want) > 500
    assert got <= want
    assert len(want - got) <= 0.002 * len(want)


def test_a_shell_is_tight_and_its_box_holds_it():
    mesh = Deformer(CANONICAL, TRIANGLES, "smooth").pose(POSED)
    found = shell(mesh, ball(), 0.05)
    low, high = box(found)
    assert torch.all(low < mesh.vertices.amin(0))
    assert torch.all(high > mesh.vertices.amax(0))
    assert (high - low).max() < 0.4
    middle = ((torch.zeros(3) - low) / found.cell).long()
    assert found.grid[tuple(middle.tolist())] > 0  # the ball is hollow
    assert 0.05 < float((found.grid == 0).float().mean()) < 0.7


def test_nothing_occupied_makes_an_empty_shell():
    mesh = Deformer(CANONICAL, TRIANGLES, "smooth").pose(POSED)
    space = ball(thickness=-1.0)
    assert np.all(shell(mesh, space, 0.03).grid.numpy() > 0)
