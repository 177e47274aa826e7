"""Adam for the CPU: one pass over memory a step; see `reference/optimiser.py`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from torch import Tensor

from ...errors import InputError
from ..reference.optimiser import check_adam, touched_rows
from .lanes import LANES, bits, fma, load, splat, square_root, store
from .threads import run_chunks

CHUNK = 1 << 16


def adam_step(
    param: Tensor,
    grad: Tensor,
    m: Tensor,
    v: Tensor,
    *,
    step: int,
    lr: float,
    beta1: float = 0.9,
    beta2: float = 0.99,
    eps: float = 1e-15,
    weight_decay: float = 0.0,
    zero_grad: bool = True,
) -> None:
    """As the reference, on contiguous float32."""
    check_adam(param, grad, m, v, step)
    arrays = [_flat(tensor) for tensor in (param, grad, m, v)]
    settings = adam_settings(step, lr, beta1, beta2, eps, weight_decay)
    run_chunks(adam_range, param.numel(), CHUNK, *arrays, settings, zero_grad)


def sparse_adam_step(
    param: Tensor,
    grad: Tensor,
    m: Tensor,
    v: Tensor,
    rows: Tensor | None = None,
    *,
    step: int,
    lr: float,
    beta1: float = 0.9,
    beta2: float = 0.99,
    eps: float = 1e-15,
    weight_decay: float = 0.0,
    zero_grad: bool = True,
) -> None:
    """As the reference, on contiguous float32."""
    check_adam(param, grad, m, v, step)
    width = param.shape[-1]
    arrays = [_flat(tensor) for tensor in (param, grad, m, v)]
    settings = adam_settings(step, lr, beta1, beta2, eps, weight_decay)
    if rows is None and param.ndim == 2:
        chunk = max(1, CHUNK // max(1, width))
        run_chunks(_adam_nonzero, len(param), chunk, width, *arrays, settings, zero_grad)
        return
    index = touched_rows(param, grad, rows).contiguous().numpy()
    chunk = max(1, CHUNK // 8 // max(1, width))
    run_chunks(_adam_rows, len(index), chunk, index, width, *arrays, settings, zero_grad)


def adam_settings(
    step: int, lr: float, beta1: float, beta2: float, eps: float, weight_decay: float
) -> np.ndarray:
    """The step's numbers as the kernel wants them, worked out in double precision."""
    rate = lr / (1 - beta1**step)
    spread = 1 / (1 - beta2**step) ** 0.5
    return np.array([rate, spread, beta1, beta2, eps, weight_decay], np.float64)


def _flat(tensor: Tensor) -> Any:
    if not tensor.is_contiguous() or tensor.device.type != "cpu":
        raise InputError("the CPU's Adam works in place on contiguous tensors in main memory only")
    array = tensor.detach().view(-1).numpy()
    if array.dtype != np.float32:
        raise InputError(f"the CPU's Adam works on float32, not on {tensor.dtype}")
    return array


@njit(cache=True, nogil=True)
def adam_range(start, stop, param, grad, m, v, settings, zero_grad):
    """A step on values start to stop of flat arrays.

    What never had a gradient stays as it is, without weight decay: it need not be read as a whole.
    """
    rate, spread, eps = splat(settings[0]), splat(settings[1]), splat(settings[4])
    keep1, take1 = splat(settings[2]), splat(1 - settings[2])
    keep2, take2 = splat(settings[3]), splat(1 - settings[3])
    decay, zero = splat(settings[5]), splat(np.float32(0))
    whole = start + (stop - start) // LANES * LANES
    for at in range(start, whole, LANES):
        g, first, second = load(grad, at), load(m, at), load(v, at)
        untouched = bits((g == zero) & (first == zero) & (second == zero))
        if settings[5] == 0 and untouched == (1 << LANES) - 1:
            continue
        value = load(param, at)
        g = fma(decay, value, g)
        first = fma(keep1, first, take1 * g)
        second = fma(keep2, second, take2 * g * g)
        store(m, at, first)
        store(v, at, second)
        store(param, at, value - rate * first / fma(square_root(second), spread, eps))
        if zero_grad:
            store(grad, at, zero)
    _adam_rest(whole, stop, param, grad, m, v, settings, zero_grad)


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _adam_rest(start, stop, param, grad, m, v, settings, zero_grad):
    """The same, one value at a time."""
    rate = np.float32(settings[0])
    spread = np.float32(settings[1])
    keep1, take1 = np.float32(settings[2]), np.float32(1 - settings[2])
    keep2, take2 = np.float32(settings[3]), np.float32(1 - settings[3])
    eps = np.float32(settings[4])
    decay = np.float32(settings[5])
    for i in range(start, stop):
        g = grad[i] + decay * param[i]
        first = keep1 * m[i] + take1 * g
        second = keep2 * v[i] + take2 * g * g
        m[i] = first
        v[i] = second
        param[i] -= rate * first / (np.sqrt(second) * spread + eps)
        if zero_grad:
            grad[i] = np.float32(0)


@njit(cache=True, nogil=True)
def _adam_rows(start, stop, rows, width, param, grad, m, v, settings, zero_grad):
    for k in range(start, stop):
        first = rows[k] * width
        adam_range(first, first + width, param, grad, m, v, settings, zero_grad)


@njit(cache=True, nogil=True)
def _adam_nonzero(start, stop, width, param, grad, m, v, settings, zero_grad):
    for row in range(start, stop):
        first = row * width
        touched = False
        for i in range(first, first + width):
            touched |= grad[i] != 0
        if touched:
            adam_range(first, first + width, param, grad, m, v, settings, zero_grad)
