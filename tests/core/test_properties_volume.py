"""What holds of any hash encoding, latent read and composited ray, in both kernels."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch
from fuzzing import MORE
from hypothesis import given, settings
from hypothesis import strategies as st

from pav_blender.core.kernels import select
from pav_blender.core.kernels.reference.encoding import PRIMES, Layout

KERNELS = {"cpu": select("cpu"), "reference": select("cpu", reference=True)}
KIND = st.sampled_from(sorted(KERNELS))
FEW = settings(max_examples=25 * MORE, deadline=None, derandomize=True)

seeds = st.integers(0, 2**32 - 1)


@st.composite
def encodings(draw):
    """A layout, dense or hashed on each level, with a table of it, and one of its levels."""
    base = draw(st.integers(1, 40))
    layout = Layout(
        draw(st.integers(1, 6)), draw(st.integers(3, 13)), base, base + draw(st.integers(0, 500))
    )
    random = generator(draw(seeds))
    tables = torch.randn(layout.entries, 2, generator=random)
    return layout, tables, draw(st.integers(0, layout.levels - 1))


def generator(seed):
    return torch.Generator().manual_seed(seed)


def corners(layout, level, seed, count=30):
    """Random corners of a level's grid, [N, 3] int64, none at the far sides."""
    return torch.randint(0, layout.resolutions[level], (count, 3), generator=generator(seed))


def at(layout, level, corner):
    """Where corners [N, 3], or places between them, lie in the unit cube."""
    return (corner.double() / layout.resolutions[level]).float()


def read(kind, points, tables, layout, level):
    """What one level says at points [N, 3]: [N, 2]."""
    return KERNELS[kind].encoding.encode(points, tables, layout)[:, 2 * level : 2 * level + 2]


def entries(layout, level, corner):
    """Rows of the table for corners [N, 3], worked out in Python's whole numbers."""
    res, first, size = (a[level] for a in (layout.resolutions, layout.offsets, layout.sizes))
    rows = []
    for x, y, z in corner.tolist():
        hashed = (x * PRIMES[0] ^ y * PRIMES[1] ^ z * PRIMES[2]) % 2**32 % size
        rows.append(first + (hashed if (res + 1) ** 3 > 2**layout.log2_entries
                             else x + (res + 1) * y + (res + 1) ** 2 * z))  # fmt: skip
    return torch.tensor(rows)


def blur(layout, level, tables):
    """How far float32 coordinates may move what a level says: 2^-23 of its resolution of a cell, a
    cell being at most twice the largest entry high in each of three directions."""
    return 2**-22 * layout.resolutions[level] * 6 * float(tables.abs().max()) + 1e-6


@FEW
@given(encodings(), seeds, KIND)
def test_a_corner_of_the_grid_is_its_entry(encoding, seed, kind):
    layout, tables, level = encoding
    corner = corners(layout, level, seed)
    corner[::2] += 1  # the far sides as well
    found = read(kind, at(layout, level, corner), tables, layout, level)
    wanted = tables[entries(layout, level, corner)]
    torch.testing.assert_close(found, wanted, rtol=0, atol=blur(layout, level, tables))


@FEW
@given(encodings(), seeds, st.integers(0, 2), st.floats(0, 1), KIND)
def test_along_an_edge_it_goes_straight(encoding, seed, axis, share, kind):
    layout, tables, level = encoding
    corner = corners(layout, level, seed)
    following = corner.clone()
    following[:, axis] += 1
    between = (1 - share) * corner.double() + share * following.double()
    found = read(kind, at(layout, level, between), tables, layout, level)
    ends = [tables[entries(layout, level, c)] for c in (corner, following)]
    wanted = (1 - share) * ends[0] + share * ends[1]
    torch.testing.assert_close(found, wanted, rtol=0, atol=blur(layout, level, tables))


@FEW
@given(encodings(), seeds, st.integers(0, 2), KIND)
def test_it_is_continuous_where_cells_meet(encoding, seed, axis, kind):
    """On both sides of a face, a ten-thousandth of a cell away, it says the same."""
    layout, tables, level = encoding
    place = corners(layout, level, seed).double()
    inside = torch.rand(place.shape, generator=generator(seed + 1), dtype=torch.float64)
    place += inside
    place[:, axis] = (place[:, axis] - inside[:, axis]).clamp(min=min(1, layout.resolutions[level]))
    step = torch.zeros(3, dtype=torch.float64)
    step[axis] = 1e-4
    below, above = (read(kind, at(layout, level, place + side * step), tables, layout, level)
                    for side in (-1, 1))  # fmt: skip
    steepest = 2 * float(tables.abs().max())
    limit = 2e-4 * steepest + blur(layout, level, tables)
    torch.testing.assert_close(below, above, rtol=0, atol=limit)


@FEW
@given(encodings(), seeds, KIND)
def test_a_point_is_between_the_corners_of_its_cell(encoding, seed, kind):
    layout, tables, level = encoding
    corner = corners(layout, level, seed)
    inside = torch.rand(corner.shape, generator=generator(seed + 1), dtype=torch.float64)
    found = read(kind, at(layout, level, corner + inside), tables, layout, level)
    steps = [torch.tensor(step) for step in product((0, 1), repeat=3)]
    around = torch.stack([tables[entries(layout, level, corner + step)] for step in steps])
    limit = blur(layout, level, tables)
    assert (found <= around.amax(0) + limit).all()
    assert (found >= around.amin(0) - limit).all()


@FEW
@given(encodings(), seeds, KIND)
def test_encoding_is_linear_and_its_gradient_the_transpose(encoding, seed, kind):
    """<encode(p, T), g> = <T, backward(p, g)>, whatever p, T and g."""
    layout, tables, _ = encoding
    random = generator(seed)
    points = torch.rand(40, 3, generator=random) * 1.2 - 0.1
    other = torch.randn(tables.shape, generator=random)
    weight = torch.randn(40, layout.width, generator=random)
    ops = KERNELS[kind].encoding
    found = ops.encode(points, tables, layout)
    summed = ops.encode(points, 2 * tables - 3 * other, layout)
    torch.testing.assert_close(
        summed, 2 * found - 3 * ops.encode(points, other, layout), rtol=1e-5, atol=2e-5
    )
    grad = torch.zeros_like(tables)
    ops.encode_backward_into(points, weight, grad, layout)
    one, two = (weight.double() * found).sum(), (grad.double() * tables).sum()
    torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-3)


@FEW
@given(seeds, st.integers(1, 9), st.integers(1, 17), KIND)
def test_a_texture_is_read_between_its_texels_and_the_gradient_is_the_transpose(
    seed, size, channels, kind
):
    random = generator(seed)
    latent = torch.randn(2, size, size, channels, generator=random)
    appearance = torch.randint(0, 2, (40,), generator=random, dtype=torch.int32)
    uv = torch.rand(40, 2, generator=random) * 1.4 - 0.2
    ops = KERNELS[kind].encoding
    found = ops.read_texture(latent, appearance, uv)
    row, column = torch.randint(0, size, (2, 40), generator=random)
    middles = (torch.stack([column, row], 1) + 0.5) / size
    there = ops.read_texture(latent, appearance, middles)
    torch.testing.assert_close(there, latent[appearance.long(), row, column], rtol=0, atol=2e-5)
    own = latent[appearance.long()].flatten(1, 2)
    assert (found <= own.amax(1) + 1e-6).all()
    assert (found >= own.amin(1) - 1e-6).all()
    weight = torch.randn(found.shape, generator=random)
    grad = torch.zeros_like(latent)
    ops.read_texture_backward_into(appearance, uv, weight, grad)
    one, two = (weight.double() * found).sum(), (grad.double() * latent).sum()
    torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-3)


@st.composite
def rays(draw):
    """Samples of some rays, packed and near first: density [N] 1/m, colour [N, 3], distance [N],
    length [N] metres, ray [N]. Some rays have none; densities from nothing to what is solid."""
    random = np.random.default_rng(draw(seeds))
    counts = random.integers(0, 9, draw(st.integers(1, 12)))
    counts[random.random(len(counts)) < 0.2] = 0
    total = int(counts.sum())
    sigma = draw(st.sampled_from([0.0, 1.0, 100.0, 1e4, 1e8])) * random.random(total)
    sigma[random.random(total) < 0.3] = 0
    length = random.uniform(1e-4, 0.02, total)
    ray = np.repeat(np.arange(len(counts)), counts)
    far = np.cumsum(length)
    floats = (sigma, random.random((total, 3)), far, length)
    packed = [torch.from_numpy(values.astype(np.float32)) for values in floats]
    return *packed, torch.from_numpy(ray.astype(np.int32)), len(counts)


def composited(kind, sigma, rgb, t, length, ray, count):
    """Colour [R, 3], opacity [R], depth [R], weights [N]."""
    return KERNELS[kind].marching.composite(sigma, rgb, t, length, ray, count)


def per_ray(values, ray, count):
    """Sums [R] over the samples of each ray, in double precision."""
    sums = torch.zeros(count, dtype=torch.float64)
    return sums.index_add(0, ray.long(), values.double())


@FEW
@given(rays(), KIND)
def test_weights_are_shares_of_one(samples, kind):
    sigma, rgb, _, length, ray, count = samples
    colour, opacity, _, weights = composited(kind, *samples)
    assert (weights >= 0).all()
    assert (weights[sigma == 0] == 0).all()
    assert (opacity <= 1 + 1e-6).all()
    torch.testing.assert_close(per_ray(weights, ray, count), opacity.double(), rtol=0, atol=1e-6)
    assert (colour <= opacity[:, None] * rgb.amax() + 1e-6 if len(rgb) else colour == 0).all()
    depth = per_ray(sigma * length, ray, count)  # optical
    torch.testing.assert_close(opacity.double(), -torch.expm1(-depth), rtol=0, atol=2e-6)


@FEW
@given(rays(), KIND)
def test_rays_without_samples_hold_nothing_and_do_not_disturb_others(samples, kind):
    sigma, rgb, t, length, ray, count = samples
    empty = torch.bincount(ray.long(), minlength=count) == 0
    colour, opacity, depth, weights = composited(kind, *samples)
    for values in (colour, opacity, depth):
        assert (values[empty] == 0).all()
    # every ray again, alone among twice as many
    wider = composited(kind, sigma, rgb, t, length, 2 * ray + 1, 2 * count + 1)
    for one, other in zip((colour, opacity, depth), wider[:3], strict=True):
        assert torch.equal(other[1::2], one)
        assert (other[::2] == 0).all()
    assert torch.equal(weights, wider[3])


@FEW
@given(rays(), KIND)
def test_transmittance_only_falls(samples, kind):
    """Sample after sample; and what is left at the end is what the picture is not opaque."""
    sigma, _, _, length, ray, count = samples
    opacity, weights = (composited(kind, *samples)[i] for i in (1, 3))
    place = torch.arange(len(ray)) - torch.searchsorted(ray, ray)
    left = torch.ones(count)
    found = torch.zeros(len(ray))
    for step in range(9):
        now, before = place == step, left.clone()
        found[now] = KERNELS[kind].marching.weigh(sigma[now], length[now], ray[now], left)
        assert (left <= before).all()
        assert (left >= 0).all()
        spent = per_ray(found[now], ray[now], count)
        torch.testing.assert_close((before - left).double(), spent, rtol=0, atol=1e-6)
    torch.testing.assert_close(found, weights, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(left, 1 - opacity, rtol=0, atol=2e-6)


@pytest.mark.parametrize("kind", KERNELS)
def test_a_solid_sample_weighs_what_is_left_before_it(kind):
    sigma, length = torch.tensor([1.0, 1e5]), torch.full((2,), 0.1)
    ray = torch.zeros(2, dtype=torch.int32)
    weights = composited(kind, sigma, torch.ones(2, 3), torch.tensor([0.1, 0.2]), length, ray, 1)[3]
    exact = -np.expm1(-0.1), np.exp(-0.1)
    np.testing.assert_allclose(weights.numpy(), exact, rtol=0, atol=1e-7)


@FEW
@given(rays(), KIND, st.floats(0.05, 0.95))
def test_a_sample_cut_in_two_shows_the_same(samples, kind, share):
    """Density and colour being the same in both parts, wherever the cut is."""
    sigma, rgb, t, length, ray, count = samples
    whole = composited(kind, *samples)
    twice = [values.repeat_interleave(2, 0) for values in (sigma, rgb, t, length, ray)]
    parts = torch.tensor([share, 1 - share]).repeat(len(length))
    cut = composited(kind, *twice[:3], twice[3] * parts, twice[4], count)
    for one, other in zip(whole[:3], cut[:3], strict=True):
        torch.testing.assert_close(other, one, rtol=2e-6, atol=2e-6)
    torch.testing.assert_close(cut[3].view(-1, 2).sum(1), whole[3], rtol=1e-5, atol=2e-6)


@FEW
@given(rays(), seeds, KIND)
def test_what_two_let_through_is_the_product(samples, seed, kind):
    """Any part of the samples and the rest: together opaque as one behind the other, and the
    nearer part's picture lies over the farther one's."""
    sigma, rgb, t, length, ray, count = samples
    place = torch.arange(len(ray)) - torch.searchsorted(ray, ray)
    near = place < torch.randint(0, 9, (1,), generator=generator(seed))
    anyhow = torch.rand(len(ray), generator=generator(seed)) < 0.5
    colour, opacity, _, _ = composited(kind, *samples)
    for chosen in (near, anyhow):
        parts = [
            composited(kind, sigma[p], rgb[p], t[p], length[p], ray[p], count)
            for p in (chosen, ~chosen)
        ]
        passes = (1 - parts[0][1]) * (1 - parts[1][1])
        torch.testing.assert_close(opacity, 1 - passes, rtol=0, atol=2e-6)
        if chosen is near:
            over = parts[0][0] + (1 - parts[0][1])[:, None] * parts[1][0]
            torch.testing.assert_close(colour, over, rtol=0, atol=3e-6)


@FEW
@given(rays(), KIND)
def test_one_colour_all_along_is_that_colour(samples, kind):
    """And samples that add nothing may be left out."""
    sigma, rgb, t, length, ray, count = samples
    same = torch.tensor([0.25, 0.5, 0.75]).expand(len(sigma), 3).contiguous()
    colour, opacity, _, _ = composited(kind, sigma, same, t, length, ray, count)
    torch.testing.assert_close(
        colour, opacity[:, None] * torch.tensor([0.25, 0.5, 0.75]), rtol=1e-5, atol=1e-6
    )
    full = sigma > 0
    fewer = composited(kind, sigma[full], rgb[full], t[full], length[full], ray[full], count)
    for one, other in zip(composited(kind, *samples)[:3], fewer[:3], strict=True):
        torch.testing.assert_close(other, one, rtol=1e-6, atol=1e-6)
