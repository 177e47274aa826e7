"""Hash encoding and latent reads: both implementations, and first principles."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pav_blender.core.errors import InputError
from pav_blender.core.kernels.cpu import encoding as cpu
from pav_blender.core.kernels.reference import encoding as reference
from pav_blender.core.kernels.reference.encoding import Layout

SMALL = Layout(levels=5, log2_entries=10, base=4, finest=64)
FULL = Layout()
BOTH = pytest.mark.parametrize("kernels", [reference, cpu], ids=["reference", "cpu"])
COUNTS = [0, 1, 2, 7, 16, 511, 512, 513, 5000]


def random_points(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, generator=generator) * 1.2 - 0.1


def random_tables(layout: Layout, seed: int = 1) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(layout.entries, 2, generator=generator)


HOSTILE = torch.tensor(
    [
        [0, 0, 0],
        [1, 1, 1],
        [1, 0, 0.5],
        [-1, 2, 0.5],
        [1e30, -1e30, 3e38],
        [float("inf"), float("-inf"), 0.5],
        [float("nan"), 0.5, 0.5],
        [float("nan")] * 3,
        [1e-40, 1 - 2**-24, 1 + 2**-23],
        [-0.0, 1 / 3, 2 / 3],
    ],
    dtype=torch.float32,
)


def test_resolutions_grow_geometrically_between_the_ends():
    grid = reference.resolutions(16, 16, 2048)
    assert (grid[0], grid[-1], len(grid)) == (16, 2048, 16)
    ratios = np.array(grid[1:]) / np.array(grid[:-1])
    assert np.all(np.abs(ratios - 128 ** (1 / 15)) < 0.07)
    assert reference.resolutions(1, 16, 2048) == [16]
    assert cpu.resolutions is reference.resolutions


@pytest.mark.parametrize(("levels", "base", "finest"), [(0, 16, 32), (4, 0, 32), (4, 16, 8)])
def test_resolutions_refuse_nonsense(levels, base, finest):
    with pytest.raises(InputError):
        reference.resolutions(levels, base, finest)


def test_levels_are_dense_as_long_as_their_corners_fit():
    assert FULL.hashed == tuple((res + 1) ** 3 > 2**18 for res in FULL.resolutions)
    for res, size, hashed in zip(FULL.resolutions, FULL.sizes, FULL.hashed, strict=True):
        assert size == 2**18 if hashed else 0 <= size - (res + 1) ** 3 < 8
        assert size % 8 == 0
    assert FULL.offsets == tuple(np.cumsum((0, *FULL.sizes[:-1])))
    assert FULL.entries == sum(FULL.sizes)


@BOTH
def test_a_corner_reads_its_own_entry(kernels):
    """Entry numbers worked out here by hand, dense and hashed."""
    tables = random_tables(SMALL)
    for level, res in enumerate(SMALL.resolutions):
        if SMALL.hashed[level] and res != 64:
            continue  # corners of other resolutions are not exact in binary
        x, y, z = 1, res // 2, res - 1
        point = torch.tensor([[x / res, y / res, z / res]])
        if SMALL.hashed[level]:
            entry = (x ^ (y * 2654435761) ^ (z * 805459861)) % 2**32 % 1024
        else:
            entry = x + (res + 1) * y + (res + 1) ** 2 * z
        got = kernels.encode(point, tables, SMALL)[0, 2 * level : 2 * level + 2]
        torch.testing.assert_close(got, tables[SMALL.offsets[level] + entry], rtol=1e-4, atol=1e-4)


@BOTH
def test_a_dense_level_reproduces_linear_functions(kernels):
    layout = Layout(levels=1, log2_entries=12, base=8, finest=8)
    z, y, x = torch.meshgrid(*[torch.arange(9.0) / 8] * 3, indexing="ij")
    tables = torch.zeros(layout.entries, 2)
    tables[:729, 0] = (2 * x - 3 * y + z).reshape(-1)
    tables[:729, 1] = 1
    points = torch.rand(300, 3)
    got = kernels.encode(points, tables, layout)
    want = points @ torch.tensor([2.0, -3.0, 1.0])
    torch.testing.assert_close(got[:, 0], want, rtol=0, atol=3e-6)
    torch.testing.assert_close(got[:, 1], torch.ones(300), rtol=0, atol=1e-6)


@pytest.mark.parametrize("layout", [SMALL, FULL], ids=["small", "full"])
@pytest.mark.parametrize("count", COUNTS)
def test_encode_agrees_with_the_reference(layout, count):
    points, tables = random_points(count), random_tables(layout)
    got = cpu.encode(points, tables, layout)
    assert got.shape == (count, layout.width)
    want = reference.encode(points, tables, layout)
    torch.testing.assert_close(got, want, rtol=1e-6, atol=2e-6)


def test_encode_agrees_with_double_precision():
    """A float32 coordinate times 2048 is uncertain by 1e-4 of a cell, and so is the value."""
    points, tables = random_points(4000), random_tables(FULL)
    got = cpu.encode(points, tables, FULL).double()
    want = reference.encode(points.double(), tables.double(), FULL)
    error = (got - want).abs().view(-1, 16, 2).amax((0, 2))
    bound = 2**-23 * 8 * torch.tensor(FULL.resolutions)
    assert (error < bound + 2e-6).all(), error


def test_hostile_points_are_clamped():
    tables = random_tables(FULL)
    got = cpu.encode(HOSTILE, tables, FULL)
    assert got.isfinite().all()
    torch.testing.assert_close(got, reference.encode(HOSTILE, tables, FULL), rtol=1e-6, atol=2e-6)
    clamped = HOSTILE.nan_to_num(0).clamp(0, 1)
    assert torch.equal(got, cpu.encode(clamped, tables, FULL))
    for kernels in (reference, cpu):
        grad = torch.zeros_like(tables)
        kernels.encode_backward_into(HOSTILE, torch.ones(len(HOSTILE), 32), grad, FULL)
        # The weights of a point sum to one on every level.
        torch.testing.assert_close(grad.sum(), torch.tensor(32.0 * len(HOSTILE)))


def test_bad_values_in_the_table_stay_where_they_are():
    tables = random_tables(SMALL)
    tables[0] = float("nan")
    tables[1] = float("inf")
    points = torch.tensor([[0.0, 0.0, 0.0], [0.9, 0.9, 0.9]])
    got = cpu.encode(points, tables, SMALL)
    assert not got[0, :2].isfinite().any()
    assert got[1].isfinite().all()


@pytest.mark.parametrize(
    ("layout", "count"), [(SMALL, 0), (SMALL, 1), (SMALL, 513), (SMALL, 5000), (FULL, 3000)]
)
def test_table_gradients_agree_with_double_precision(layout, count):
    points = random_points(count)
    # Exactly representable grid positions on every level keep the comparison free of cell rounding.
    points = (points * 256).round() / 256
    tables = random_tables(layout).requires_grad_()
    weight = torch.randn(count, layout.width, generator=torch.Generator().manual_seed(2))
    (got,) = torch.autograd.grad(cpu.encode(points, tables, layout), tables, weight)
    double = tables.detach().double().requires_grad_()
    out = reference.encode(points.double(), double, layout)
    (want,) = torch.autograd.grad(out, double, weight.double())
    scale = float(weight.abs().max()) if count else 1.0
    bounds = torch.tensor(layout.resolutions).repeat_interleave(torch.tensor(layout.sizes))
    error = (got.double() - want).abs().amax(1)
    assert (error < scale * (2**-22 * bounds + 1e-5)).all()


@BOTH
def test_gradients_are_added_not_written(kernels):
    points, out = random_points(100), torch.randn(100, SMALL.width)
    once, twice = torch.zeros(SMALL.entries, 2), torch.ones(SMALL.entries, 2)
    kernels.encode_backward_into(points, out, once, SMALL)
    kernels.encode_backward_into(points, out, twice, SMALL)
    torch.testing.assert_close(twice, once + 1)
    assert once.abs().sum() > 0


@pytest.mark.parametrize(("layout", "count"), [(SMALL, 0), (SMALL, 700), (FULL, 700)])
def test_adam_on_tables_is_backward_and_then_adam(layout, count):
    points, tables = random_points(count), random_tables(layout)
    ours = [tables.clone(), torch.zeros_like(tables), torch.zeros_like(tables)]
    theirs = [tables.clone(), torch.zeros_like(tables), torch.zeros_like(tables)]
    settings = {"lr": 1e-2, "eps": 1e-8, "weight_decay": 1e-3}
    generator = torch.Generator().manual_seed(4)
    for step in (1, 2, 3):
        grad_out = torch.randn(count, layout.width, generator=generator)
        cpu.encode_adam_step(points, grad_out, *ours, layout, step=step, **settings)
        reference.encode_adam_step(points, grad_out, *theirs, layout, step=step, **settings)
    for one, two in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-5)
    assert not torch.equal(ours[0], tables)


@BOTH
def test_grids_side_by_side_are_each_by_itself(kernels):
    layouts = SMALL, Layout(levels=2, log2_entries=9, base=8, finest=16)
    points = [random_points(700), random_points(700, 5)]
    tables = [random_tables(layout) for layout in layouts]
    alone = torch.cat(
        [kernels.encode(*grid) for grid in zip(points, tables, layouts, strict=True)], 1
    )
    learned = [table.clone().requires_grad_() for table in tables]
    for held in (tables, learned):
        both = kernels.encode_all([*zip(points, held, layouts, strict=True)])
        assert torch.equal(both, alone)
    both.sum().backward()
    assert all(table.grad.abs().sum() > 0 for table in learned)

    parts = torch.randn(700, alone.shape[1]).split([layout.width for layout in layouts], 1)
    zeros = [[torch.zeros_like(table) for table in tables] for _ in range(4)]
    own, other = [t.clone() for t in tables], [t.clone() for t in tables]
    grids = zip(points, parts, own, *zeros[:2], layouts, strict=True)
    kernels.encode_adam_steps([*grids], step=1, lr=1e-2)
    for grid in zip(points, parts, other, *zeros[2:], layouts, strict=True):
        kernels.encode_adam_step(*grid, step=1, lr=1e-2)
    for one, two, before in zip(own, other, tables, strict=True):
        assert torch.equal(one, two)
        assert not torch.equal(one, before)


def test_reference_gradients():
    layout = Layout(levels=3, log2_entries=6, base=2, finest=7)
    points = torch.rand(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    tables = torch.randn(layout.entries, 2, dtype=torch.float64)
    points, tables = points.requires_grad_(), tables.requires_grad_()
    assert torch.autograd.gradcheck(lambda p, t: reference.encode(p, t, layout), (points, tables))


def test_encode_repeats_itself_exactly(monkeypatch):
    points, tables = random_points(20000), random_tables(FULL)
    out = torch.randn(20000, FULL.width)
    values, grads = [], []
    for workers in ("1", "2", "5", "2"):
        monkeypatch.setenv("PAV_THREADS", workers)
        values.append(cpu.encode(points, tables, FULL))
        grads.append(torch.zeros_like(tables))
        cpu.encode_backward_into(points, out, grads[-1], FULL)
    assert all(torch.equal(values[0], value) for value in values)
    assert all(torch.equal(grads[0], grad) for grad in grads)


@settings(deadline=None, max_examples=40)
@given(
    st.integers(1, 6),
    st.integers(3, 12),
    st.integers(1, 9),
    st.integers(0, 300),
    st.integers(0, 40),
)
def test_any_layout(levels, log2_entries, base, growth, count):
    layout = Layout(levels, log2_entries, base, base + growth)
    points, tables = random_points(count, seed=count), random_tables(layout)
    got, want = (kernels.encode(points, tables, layout) for kernels in (cpu, reference))
    torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-5)
    weight = torch.randn_like(got)
    grads = [torch.zeros_like(tables) for _ in range(2)]
    cpu.encode_backward_into(points, weight, grads[0], layout)
    reference.encode_backward_into(points, weight, grads[1], layout)
    torch.testing.assert_close(*grads, rtol=1e-4, atol=1e-4)


def test_inputs_that_do_not_fit_are_refused():
    tables = random_tables(SMALL)
    with pytest.raises(InputError, match="points have shape"):
        cpu.encode(torch.rand(3, 2), tables, SMALL)
    with pytest.raises(InputError, match="the layout needs"):
        cpu.encode(torch.rand(3, 3), tables[1:], SMALL)
    with pytest.raises(InputError, match="float32"):
        cpu.encode(torch.rand(3, 3).double(), tables, SMALL)
    with pytest.raises(InputError, match="no gradient for points"):
        cpu.encode(torch.rand(3, 3, requires_grad=True), tables, SMALL)


def test_strided_tensors_work():
    points = random_points(60)[::2]
    tables = random_tables(SMALL)
    got = cpu.encode(points, tables, SMALL)
    assert torch.equal(got, cpu.encode(points.contiguous(), tables, SMALL))


def texture_input(count: int, size: int = 9, channels: int = 5):
    generator = torch.Generator().manual_seed(count)
    latent = torch.randn(3, size, size, channels, generator=generator)
    appearance = torch.randint(0, 3, (count,), generator=generator, dtype=torch.int32)
    return latent, appearance, torch.rand(count, 2, generator=generator) * 1.4 - 0.2


@BOTH
def test_texture_rows_begin_below(kernels):
    latent = torch.arange(32.0).view(2, 4, 4, 1)
    uv = torch.tensor([[0.125, 0.125], [0.375, 0.125], [0.125, 0.375], [1.0, 1.0], [0.25, 0.125]])
    got = kernels.read_texture(latent, torch.tensor([0, 0, 0, 1, 1], dtype=torch.int32), uv)
    assert got[:, 0].tolist() == [0, 1, 4, 31, 16.5]


@pytest.mark.parametrize(("size", "channels"), [(1, 3), (2, 1), (9, 5), (64, 16), (64, 17)])
@pytest.mark.parametrize("count", [0, 1, 5000])
def test_texture_agrees_with_double_precision(size, channels, count):
    latent, appearance, uv = texture_input(count, size, channels)
    latent.requires_grad_()
    got = cpu.read_texture(latent, appearance, uv)
    double = latent.detach().double().requires_grad_()
    want = reference.read_texture(double, appearance, uv.double())
    torch.testing.assert_close(got.double(), want, rtol=0, atol=2e-6 * size)
    weight = torch.randn_like(got)
    (grad,) = torch.autograd.grad(got, latent, weight)
    (wanted,) = torch.autograd.grad(want, double, weight.double())
    bound = 1e-6 * size * (1 + count / size**2)
    torch.testing.assert_close(grad.double(), wanted, rtol=1e-4, atol=bound)


def test_hostile_uv_is_clamped():
    uv = HOSTILE[:, :2].contiguous()
    latent, _, _ = texture_input(1)
    appearance = torch.zeros(len(uv), dtype=torch.int32)
    got = cpu.read_texture(latent, appearance, uv)
    torch.testing.assert_close(got, reference.read_texture(latent, appearance, uv))


def test_reads_of_what_is_not_there_are_refused():
    latent, appearance, uv = texture_input(10)
    with pytest.raises(InputError, match="appearance holds 0 to 3"):
        cpu.read_texture(latent, appearance.clamp(0, 0).index_fill(0, torch.tensor([3]), 3), uv)
    with pytest.raises(InputError, match="need \\[10\\]"):
        cpu.read_texture(latent, appearance[:9], uv)
    features, which, triangles, triangle, barycentric = vertices_input(10)
    with pytest.raises(InputError, match="triangle holds -1"):
        cpu.read_vertices(features, which, triangles, triangle - triangle.min() - 1, barycentric)
    with pytest.raises(InputError, match="triangles holds"):
        cpu.read_vertices(features, which, triangles + 20, triangle, barycentric)


def vertices_input(count: int, channels: int = 5):
    generator = torch.Generator().manual_seed(count)
    features = torch.randn(3, 20, channels, generator=generator)
    appearance = torch.randint(0, 3, (count,), generator=generator, dtype=torch.int32)
    triangles = torch.randint(0, 20, (30, 3), generator=generator, dtype=torch.int32)
    triangle = torch.randint(0, 30, (count,), generator=generator, dtype=torch.int32)
    barycentric = torch.rand(count, 3, generator=generator)
    return features, appearance, triangles, triangle, barycentric / barycentric.sum(1, True)


@pytest.mark.parametrize("channels", [1, 5, 16])
@pytest.mark.parametrize("count", [0, 1, 5000])
def test_vertices_agree_with_double_precision(channels, count):
    features, appearance, triangles, triangle, barycentric = vertices_input(count, channels)
    features.requires_grad_()
    got = cpu.read_vertices(features, appearance, triangles, triangle, barycentric)
    double = features.detach().double().requires_grad_()
    want = reference.read_vertices(double, appearance, triangles, triangle, barycentric.double())
    torch.testing.assert_close(got.double(), want, rtol=1e-6, atol=1e-6)
    weight = torch.randn_like(got)
    (grad,) = torch.autograd.grad(got, features, weight)
    (wanted,) = torch.autograd.grad(want, double, weight.double())
    torch.testing.assert_close(grad.double(), wanted, rtol=1e-5, atol=1e-4)


def test_reference_read_gradients():
    latent, appearance, uv = texture_input(6, 4, 2)
    uv = (uv.double().clamp(0.15, 0.85)).requires_grad_()
    latent = latent.double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda t, c: reference.read_texture(t, appearance, c), (latent, uv)
    )
    features, which, triangles, triangle, barycentric = vertices_input(6, 2)
    doubles = features.double().requires_grad_(), barycentric.double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda f, b: reference.read_vertices(f, which, triangles, triangle, b), doubles
    )


def test_reads_repeat_themselves_exactly(monkeypatch):
    latent, appearance, uv = texture_input(5000, 16, 7)
    weight = torch.randn(5000, 7)
    grads = []
    for workers in ("1", "2", "4"):
        monkeypatch.setenv("PAV_THREADS", workers)
        grads.append(torch.zeros_like(latent))
        cpu.read_texture_backward_into(appearance, uv, weight, grads[-1])
    assert all(torch.equal(grads[0], grad) for grad in grads)
