"""Adam: both implementations against torch.optim, dense and sparse."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pav_blender.core.errors import InputError
from pav_blender.core.kernels.cpu import optimiser as cpu
from pav_blender.core.kernels.reference import optimiser as reference

BOTH = pytest.mark.parametrize("kernels", [reference, cpu], ids=["reference", "cpu"])
RATES = {"beta1": 0.9, "beta2": 0.99, "eps": 1e-15}


def run_ours(step_function, param, grads, **settings):
    """Steps over the gradients in turn -> parameters, both moments."""
    param, m, v = param.clone(), torch.zeros_like(param), torch.zeros_like(param)
    for step, grad in enumerate(grads, 1):
        step_function(param, grad.clone(), m, v, step=step, **settings)
    return param, m, v


def run_torch(param, grads, lr, beta1, beta2, eps, weight_decay=0.0):
    param = param.double().requires_grad_()
    adam = torch.optim.Adam([param], lr, (beta1, beta2), eps, weight_decay)
    for grad in grads:
        param.grad = grad.double()
        adam.step()
    state = adam.state[param]
    return param.detach(), state["exp_avg"], state["exp_avg_sq"]


@BOTH
@pytest.mark.parametrize("count", [1, 15, 1000, 200_003])
@pytest.mark.parametrize("weight_decay", [0.0, 1e-2])
def test_matches_torch(kernels, count, weight_decay):
    generator = torch.Generator().manual_seed(count)
    param = torch.randn(count, generator=generator)
    grads = [torch.randn(count, generator=generator) * 10.0**-i for i in range(6)]
    got = run_ours(kernels.adam_step, param, grads, lr=1e-2, weight_decay=weight_decay, **RATES)
    want = run_torch(param, grads, lr=1e-2, weight_decay=weight_decay, **RATES)
    for one, two in zip(got, want, strict=True):
        torch.testing.assert_close(one.double(), two, rtol=2e-5, atol=1e-6)


@BOTH
def test_a_gradient_is_zeroed_only_when_asked(kernels):
    param, m, v = torch.ones(40), torch.zeros(40), torch.zeros(40)
    grad = torch.ones(40)
    kernels.adam_step(param, grad, m, v, step=1, lr=0.1, zero_grad=False)
    assert grad.eq(1).all()
    torch.testing.assert_close(param, torch.full((40,), 0.9))
    kernels.adam_step(param, grad, m, v, step=2, lr=0.1)
    assert grad.eq(0).all()


@BOTH
def test_no_gradient_means_no_step_and_no_nan(kernels):
    """eps of 1e-15 is lost beside anything, but not beside zero."""
    param, zero = torch.randn(100), torch.zeros(100)
    before = param.clone()
    kernels.adam_step(param, zero.clone(), zero.clone(), zero.clone(), step=1, lr=0.1, eps=1e-15)
    assert torch.equal(param, before)


@BOTH
def test_tiny_and_huge_gradients_move_by_the_learning_rate(kernels):
    grad = torch.tensor([1e-12, -1e-12, 1e15, -1e15, 1.0])
    param, zero = torch.zeros(5), torch.zeros(5)
    kernels.adam_step(param, grad.clone(), zero.clone(), zero.clone(), step=1, lr=0.1, eps=1e-15)
    torch.testing.assert_close(param, -0.1 * grad.sign(), rtol=2e-3, atol=0)


@BOTH
def test_bad_gradients_stay_where_they_are(kernels):
    param, m, v = torch.zeros(100), torch.zeros(100), torch.zeros(100)
    grad = torch.ones(100)
    grad[17] = float("nan")
    kernels.adam_step(param, grad, m, v, step=1, lr=0.1)
    assert param[17].isnan()
    torch.testing.assert_close(param[param.isfinite()], torch.full((99,), -0.1))


@BOTH
def test_an_empty_parameter_is_fine(kernels):
    kernels.adam_step(*[torch.zeros(0) for _ in range(4)], step=1, lr=0.1)
    kernels.sparse_adam_step(*[torch.zeros(0, 4) for _ in range(4)], step=1, lr=0.1)
    kernels.sparse_adam_step(
        *[torch.zeros(3, 4) for _ in range(4)], torch.zeros(0, dtype=torch.int64), step=1, lr=0.1
    )


def sparse_input(rows, width, seed=0):
    generator = torch.Generator().manual_seed(seed)
    param = torch.randn(rows, width, generator=generator)
    grads = []
    for _ in range(5):
        grad = torch.randn(rows, width, generator=generator)
        grad[torch.rand(rows, generator=generator) < 0.7] = 0
        grads.append(grad)
    return param, grads


@BOTH
@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize(("rows", "width"), [(1, 1), (50, 16), (5000, 16), (301, 3)])
def test_sparse_matches_torch(kernels, listed, rows, width):
    param, grads = sparse_input(rows, width)
    theirs = torch.nn.Parameter(param.double())
    adam = torch.optim.SparseAdam([theirs], lr=1e-2, betas=(0.9, 0.99), eps=1e-15)
    ours, m, v = param.clone(), torch.zeros_like(param), torch.zeros_like(param)
    for step, grad in enumerate(grads, 1):
        touched = grad.abs().sum(1).nonzero().squeeze(1)
        theirs.grad = torch.sparse_coo_tensor(
            touched[None], grad[touched].double(), grad.shape, check_invariants=True
        )
        adam.step()
        index = touched.int() if listed else None
        kernels.sparse_adam_step(ours, grad, m, v, index, step=step, lr=1e-2, **RATES)
        assert grad.eq(0).all()
    torch.testing.assert_close(ours.double(), theirs.detach(), rtol=2e-5, atol=1e-6)


@BOTH
def test_sparse_leaves_other_rows_alone(kernels):
    param, m, v = torch.randn(10, 4), torch.randn(10, 4), torch.rand(10, 4)
    before = [t.clone() for t in (param, m, v)]
    grad = torch.zeros(10, 4)
    grad[3, 2] = 1
    kernels.sparse_adam_step(param, grad, m, v, step=5, lr=0.1)
    for now, then in zip((param, m, v), before, strict=True):
        changed = (now != then).any(1).nonzero().squeeze(1).tolist()
        assert changed == [3]


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 200), st.integers(1, 20), st.integers(1, 10000), st.floats(0, 0.1))
def test_both_agree(rows, width, step, weight_decay):
    generator = torch.Generator().manual_seed(rows)
    state = [torch.rand(rows, width, generator=generator) for _ in range(4)]
    one, two = [t.clone() for t in state], [t.clone() for t in state]
    reference.adam_step(*one, step=step, lr=1e-3, weight_decay=weight_decay)
    cpu.adam_step(*two, step=step, lr=1e-3, weight_decay=weight_decay)
    for a, b in zip(one, two, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)


def test_what_does_not_fit_is_refused():
    four = [torch.zeros(4, 4) for _ in range(4)]
    with pytest.raises(InputError, match="need one"):
        cpu.adam_step(torch.zeros(5), *four[1:], step=1, lr=0.1)
    with pytest.raises(InputError, match="steps count from 1"):
        cpu.adam_step(*four, step=0, lr=0.1)
    with pytest.raises(InputError, match="contiguous"):
        cpu.adam_step(*[t.t()[:, :3] for t in four], step=1, lr=0.1)
    with pytest.raises(InputError, match="float32"):
        cpu.adam_step(*[t.double() for t in four], step=1, lr=0.1)
    with pytest.raises(InputError, match="rows hold"):
        cpu.sparse_adam_step(*four, torch.tensor([4]), step=1, lr=0.1)
    with pytest.raises(InputError, match=r"need \[R,C\]"):
        cpu.sparse_adam_step(*[torch.zeros(4) for _ in range(4)], step=1, lr=0.1)
