"""Small networks: values and gradients of both implementations."""

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pav_blender.core.errors import InputError
from pav_blender.core.kernels.cpu import mlp as cpu
from pav_blender.core.kernels.reference import mlp as reference

NETS = [(32, 64, 16), (48, 64, 64, 1), (16, 64, 64, 64, 3), (20, 32, 7), (33, 128, 128, 16), (5, 2)]


def network(sizes, seed=0):
    generator = torch.Generator().manual_seed(seed)
    pairs = list(pairwise(sizes))
    weights = [torch.randn(o, i, generator=generator) * (2 / i) ** 0.5 for i, o in pairs]
    biases = [torch.randn(o, generator=generator) * 0.1 for o in sizes[1:]]
    return weights, biases


def batch(count, sizes, groups=7, seed=1):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(count, sizes[0], generator=generator)
    group_bias = torch.randn(groups, sizes[1], generator=generator)
    group = torch.randint(0, groups, (count,), generator=generator, dtype=torch.int32)
    weight = torch.randn(count, sizes[-1], generator=generator)
    return x, group_bias, group, weight


def gradients(kernels, x, weights, biases, group_bias, group, weight):
    """The output and its gradient to everything."""
    weights = [w.detach().requires_grad_() for w in weights]
    biases = [b.detach().requires_grad_() for b in biases]
    leaves = [x.detach().requires_grad_(), *weights, *biases]
    if group_bias is not None:
        group_bias = group_bias.detach().requires_grad_()
        leaves.append(group_bias)
    out = kernels.mlp(leaves[0], weights, biases, group_bias, group)
    return [out, *torch.autograd.grad(out, leaves, weight)]


def double(value):
    if isinstance(value, list):
        return [double(v) for v in value]
    return value.double() if value is not None and value.is_floating_point() else value


def assert_near_double(kernels, *args, bound=2e-5):
    """Every result within `bound` of the double precision one, relative to its largest entry."""
    got = gradients(kernels, *args)
    want = gradients(reference, *[double(a) for a in args])
    for one, two in zip(got, want, strict=True):
        assert one.shape == two.shape
        if one.numel():
            assert (one.double() - two).abs().max() <= bound * (1 + two.abs().max())


@pytest.mark.parametrize("sizes", NETS, ids=str)
@pytest.mark.parametrize("count", [0, 1, 127, 128, 129, 5000])
@pytest.mark.parametrize("grouped", [False, True])
def test_values_and_gradients_agree_with_double_precision(sizes, count, grouped):
    weights, biases = network(sizes)
    x, group_bias, group, weight = batch(count, sizes)
    if not grouped:
        group_bias = group = None
    assert_near_double(cpu, x, weights, biases, group_bias, group, weight)


def test_many_samples_and_many_groups():
    """As in training: samples of a ray lie together and every ray is a group."""
    sizes = (48, 64, 64, 3)
    weights, biases = network(sizes)
    x, group_bias, _, weight = batch(40000, sizes, groups=4096)
    group = (torch.arange(40000) * 4096 // 40000).int()
    assert_near_double(cpu, x, weights, biases, group_bias, group, weight)


def test_a_group_bias_is_a_wider_input():
    """What the group's row adds is what inputs shared by the group would have added."""
    weights, biases = network((24, 64, 16))
    x = torch.randn(300, 24)
    group = torch.randint(0, 5, (300,), dtype=torch.int32)
    shared = torch.randn(5, 8)
    full = torch.cat([x[:, :16], shared[group.long()]], 1)
    want = reference.mlp(full, weights, biases)
    for kernels in (reference, cpu):
        got = kernels.mlp(
            x[:, :16].contiguous(),
            [weights[0][:, :16].contiguous(), weights[1]],
            biases,
            shared @ weights[0][:, 16:].t(),
            group,
        )
        torch.testing.assert_close(got, want, rtol=1e-5, atol=2e-5)


def test_reference_gradients():
    sizes = (4, 6, 5, 2)
    weights, biases = network(sizes)
    x, group_bias, group, _ = batch(7, sizes, groups=3)
    inputs = [t.double().requires_grad_() for t in (x, group_bias, *weights, *biases)]
    assert torch.autograd.gradcheck(
        lambda x, g, *layers: reference.mlp(x, layers[:3], layers[3:], g, group), inputs
    )


def test_repeats_itself_exactly():
    sizes = (32, 64, 64, 16)
    weights, biases = network(sizes)
    args = batch(20000, sizes)
    x, group_bias, group, weight = args
    runs = [gradients(cpu, x, weights, biases, group_bias, group, weight) for _ in range(3)]
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


def test_values_do_not_depend_on_the_batch():
    """A sample's value is the same wherever in a batch it lies, so tiles of a picture match."""
    sizes = (32, 64, 64, 16)
    weights, biases = network(sizes)
    x, group_bias, group, _ = batch(1000, sizes)
    whole = cpu.mlp(x, weights, biases, group_bias, group)
    for start, stop in [(0, 1), (1, 130), (77, 1000), (999, 1000)]:
        part = cpu.mlp(x[start:stop], weights, biases, group_bias, group[start:stop])
        torch.testing.assert_close(part, whole[start:stop], rtol=1e-5, atol=1e-5)


def test_bad_samples_do_not_spoil_others():
    sizes = (32, 64, 64, 16)
    weights, biases = network(sizes)
    x, _, _, _ = batch(300, sizes)
    clean = cpu.mlp(x, weights, biases)
    bad = x.clone()
    bad[3] = float("nan")
    bad[140, 5] = float("inf")
    bad[299] = 1e38
    got = cpu.mlp(bad, weights, biases)
    rest = torch.ones(300, dtype=torch.bool)
    rest[[3, 140, 299]] = False
    torch.testing.assert_close(got[rest], clean[rest], rtol=1e-6, atol=1e-6)
    assert got[3].isnan().all()


def test_huge_values_stay_proportional():
    weights, biases = network((32, 64, 16))
    biases = [b * 0 for b in biases]
    x = torch.randn(50, 32)
    got = cpu.mlp(x * 1e18, weights, biases)
    torch.testing.assert_close(got, cpu.mlp(x, weights, biases) * 1e18, rtol=1e-3, atol=1e13)


@settings(deadline=None, max_examples=40)
@given(
    st.lists(st.integers(1, 70), min_size=2, max_size=5),
    st.integers(0, 300),
    st.integers(1, 5),
    st.booleans(),
)
def test_any_size(sizes, count, groups, grouped):
    weights, biases = network(sizes)
    x, group_bias, group, weight = batch(count, sizes, groups)
    if not grouped:
        group_bias = group = None
    assert_near_double(cpu, x, weights, biases, group_bias, group, weight)


def test_gradients_only_where_asked():
    weights, biases = network((32, 64, 16))
    x, _, _, weight = batch(100, (32, 64, 16))
    x.requires_grad_()
    out = cpu.mlp(x, weights, biases)
    out.backward(weight)
    assert x.grad is not None
    assert all(w.grad is None for w in weights)


@pytest.mark.parametrize("count", [1, 95, 96, 97, 3000])
@pytest.mark.parametrize("sizes", [(32, 64, 64, 16), (20, 64, 3)], ids=str)
def test_inputs_may_lie_feature_by_feature(sizes, count):
    weights, biases = network(sizes)
    x, group_bias, group, weight = batch(count, sizes)
    turned = x.t().contiguous().t()
    rows = gradients(cpu, x, weights, biases, group_bias, group, weight)
    columns = gradients(cpu, turned, weights, biases, group_bias, group, weight)
    assert columns[1].stride() == turned.stride()
    for one, two in zip(rows, columns, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-6, atol=1e-6)


def test_strided_tensors_work():
    weights, biases = network((16, 64, 4))
    x = torch.randn(100, 32)[:, ::2]
    x.requires_grad_()
    got = cpu.mlp(x, [weights[0].t().contiguous().t(), weights[1]], biases)
    want = reference.mlp(x, weights, biases)
    torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-5)
    (one,), (two,) = (torch.autograd.grad(out.sum(), x) for out in (got, want))
    torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kernels", [reference, cpu], ids=["reference", "cpu"])
def test_layers_that_do_not_fit_are_refused(kernels):
    weights, biases = network((8, 64, 4))
    x, group_bias, group, _ = batch(10, (8, 64, 4))
    with pytest.raises(InputError, match="layer 0 gets 7"):
        kernels.mlp(x[:, :7], weights, biases)
    with pytest.raises(InputError, match="2 weights and 1 biases"):
        kernels.mlp(x, weights, biases[:1])
    with pytest.raises(InputError, match="one of them is missing"):
        kernels.mlp(x, weights, biases, group_bias)
    with pytest.raises(InputError, match="group holds"):
        kernels.mlp(x, weights, biases, group_bias, group + 7)
    with pytest.raises(InputError, match="group_bias has shape"):
        kernels.mlp(x, weights, biases, group_bias[:, :5], group)
