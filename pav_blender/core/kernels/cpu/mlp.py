"""Small multi-layer perceptrons for the CPU; see `reference/mlp.py`.

Blocks of samples go through all layers while they lie in the first cache. Rows stay rows: a layer
is `init + x @ W^T` for a few dozen samples at a time, and its two gradients are products of the
same kind, so one routine (`tiles.multiply`) does everything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ...errors import InputError
from ..reference import mlp as reference
from .threads import run_chunks
from .tiles import LANES, MASKED, PLAIN, RELU, ROWS, multiply

BLOCK = 8 * ROWS  # samples that go through the layers together
CHUNK = 16 * BLOCK  # samples handed to a thread at a time
PARTS = 16  # sums of gradients are kept this many times over: their order never depends on threads
# Columns of a plan, one row a layer: sizes, sizes rounded up to LANES, and where things begin.
IN, OUT, IN_PAD, OUT_PAD, FORWARD, BIAS, BACKWARD, HIDDEN, GRAD_WEIGHT, GRAD_BIAS = range(10)


def mlp(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    group_bias: Tensor | None = None,
    group: Tensor | None = None,
) -> Tensor:
    """As the reference, in float32; hidden values are not kept but computed again for gradients."""
    reference.check_mlp(x, weights, biases, group_bias, group)
    return _Mlp.apply(x, group_bias, group, *weights, *biases)


@dataclass(frozen=True)
class Gradients:
    """What `mlp_backward` returns; `x` and `group_bias` where they were asked for."""

    x: Tensor | None
    weights: list[Tensor]
    biases: list[Tensor]
    group_bias: Tensor | None


def mlp_backward(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    group_bias: Tensor | None,
    group: Tensor | None,
    grad_out: Tensor,
    *,
    need_x: bool = True,
) -> Gradients:
    """Gradients of `mlp` given that of its output [N,out]; the same for any number of threads."""
    reference.check_mlp(x, weights, biases, group_bias, group)
    net = _Net.pack(weights, biases)
    count = len(x)
    blocks = -(-count // BLOCK)
    parts = max(1, min(PARTS, blocks // 4))
    size = -(-blocks // parts) * BLOCK
    sums = np.zeros((parts, net.sums), np.float32)
    grad_x = torch.empty(count if need_x else 0, x.shape[1])
    bias_rows, which = _group_arrays(group_bias, group, count)
    spans = _group_spans(which, count, size, parts)
    group_sums = np.zeros((int(spans[:, 2].sum()), bias_rows.shape[1]), np.float32)
    run_chunks(
        _backward_part,
        parts,
        1,
        size,
        _array(x),
        net.packed,
        net.plan,
        bias_rows,
        which,
        _array(grad_out),
        grad_x.numpy(),
        sums,
        spans,
        group_sums,
    )
    total = sums.sum(0)
    grad_weights, grad_biases = net.unpack(total)
    grad_group = None
    if group_bias is not None:
        summed = np.zeros(tuple(group_bias.shape), np.float32)
        for low, at, length in spans:
            summed[low : low + length] += group_sums[at : at + length]
        grad_group = torch.from_numpy(summed)
    return Gradients(grad_x if need_x else None, grad_weights, grad_biases, grad_group)


class _Mlp(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, group_bias: Tensor | None, group: Tensor | None, *layers: Tensor
    ) -> Tensor:
        ctx.save_for_backward(x, group_bias, group, *layers)
        net = _Net.pack(layers[: len(layers) // 2], layers[len(layers) // 2 :])
        out = torch.empty(len(x), int(net.plan[-1, OUT]))
        bias_rows, which = _group_arrays(group_bias, group, len(x))
        arrays = (_array(x), net.packed, net.plan, bias_rows, which, out.numpy())
        run_chunks(_forward_samples, len(x), CHUNK, *arrays)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, group_bias, group, *layers = ctx.saved_tensors
        half = len(layers) // 2
        need_x = ctx.needs_input_grad[0]
        result = mlp_backward(
            x, layers[:half], layers[half:], group_bias, group, grads[0], need_x=need_x
        )
        return result.x, result.group_bias, None, *result.weights, *result.biases


@dataclass(frozen=True)
class _Net:
    """Weights laid out for `tiles.multiply`: padded, both ways round, in one array."""

    packed: np.ndarray
    plan: np.ndarray  # [layers, 10]
    sums: int  # floats of the gradients of all layers

    @staticmethod
    def pack(weights: Sequence[Tensor], biases: Sequence[Tensor]) -> _Net:
        plan = np.zeros((len(weights), 10), np.int64)
        at = sums = 0
        hidden = BLOCK * _padded(weights[0].shape[1])  # after the inputs
        for row, weight in zip(plan, weights, strict=True):
            outs, ins = weight.shape
            row[: BACKWARD + 1] = ins, outs, _padded(ins), _padded(outs), at, 0, 0
            row[BIAS] = at + ins * row[OUT_PAD]
            row[BACKWARD] = row[BIAS] + row[OUT_PAD]
            at = row[BACKWARD] + outs * row[IN_PAD]
            row[HIDDEN] = hidden
            hidden += BLOCK * row[OUT_PAD]
            row[GRAD_WEIGHT] = sums
            row[GRAD_BIAS] = sums + -(-outs // ROWS) * ROWS * row[IN_PAD]
            sums = row[GRAD_BIAS] + row[OUT_PAD]
        packed = np.zeros(at, np.float32)
        for row, weight, bias in zip(plan, weights, biases, strict=True):
            matrix, (ins, outs) = _array(weight), row[:2]
            forward = packed[row[FORWARD] : row[BIAS]].reshape(ins, row[OUT_PAD])
            forward[:, :outs] = matrix.T
            packed[row[BIAS] : row[BIAS] + outs] = _array(bias)
            backward = packed[row[BACKWARD] : row[BACKWARD] + outs * row[IN_PAD]]
            backward.reshape(outs, row[IN_PAD])[:, :ins] = matrix
        return _Net(packed, plan, int(sums))

    def unpack(self, sums: np.ndarray) -> tuple[list[Tensor], list[Tensor]]:
        """Gradients of weights and biases from the sums of all layers."""
        weights, biases = [], []
        for row in self.plan:
            ins, outs, pad = row[IN], row[OUT], row[IN_PAD]
            weight = sums[row[GRAD_WEIGHT] : row[GRAD_WEIGHT] + outs * pad].reshape(outs, pad)
            weights.append(torch.from_numpy(weight[:, :ins].copy()))
            biases.append(torch.from_numpy(sums[row[GRAD_BIAS] : row[GRAD_BIAS] + outs].copy()))
        return weights, biases


def _padded(size: int) -> int:
    return -(-size // LANES) * LANES


def _group_arrays(
    group_bias: Tensor | None, group: Tensor | None, count: int
) -> tuple[np.ndarray, np.ndarray]:
    if group_bias is None or group is None:
        return np.zeros((0, 0), np.float32), np.zeros(0, np.int32)
    return _array(group_bias), group.detach().to(torch.int32).contiguous().numpy()


def _group_spans(which: np.ndarray, count: int, size: int, parts: int) -> np.ndarray:
    """Lowest group, first row of its own sums, and number of rows, for every part.

    Groups mostly come in order (rays, frames), so that the parts' sums barely overlap.
    """
    spans = np.zeros((parts, 3), np.int64)
    at = 0
    for part in range(parts if len(which) else 0):
        mine = which[part * size : (part + 1) * size]
        if len(mine):
            low, high = int(mine.min()), int(mine.max())
            spans[part] = low, at, high - low + 1
            at += high - low + 1
    return spans


def _array(tensor: Tensor) -> Any:
    if tensor.device.type != "cpu" or tensor.dtype != torch.float32:
        raise InputError(
            f"CPU kernels work on float32 in main memory, not on {tensor.dtype} on {tensor.device}"
        )
    return tensor.detach().contiguous().numpy()


@njit(cache=True, nogil=True)
def _scratch(plan):
    """Room for a block's inputs and the results of all layers; products may read a little past."""
    last = plan[-1]
    return np.zeros(last[HIDDEN] + BLOCK * last[OUT_PAD] + ROWS * LANES, np.float32)


@njit(cache=True, nogil=True)
def _copy_in(source, begin, count, work, at, step):
    """Rows of source as rows of work; what is left of the block becomes zero."""
    width = source.shape[1]
    for i in range(count):
        row = work[at + i * step : at + (i + 1) * step]
        for k in range(width):
            row[k] = source[begin + i, k]
        row[width:] = 0
    work[at + count * step : at + BLOCK * step] = 0


@njit(cache=True, nogil=True)
def _copy_out(work, at, step, target, begin, count):
    for i in range(count):
        row = work[at + i * step : at + (i + 1) * step]
        for k in range(target.shape[1]):
            target[begin + i, k] = row[k]


@njit(cache=True, nogil=True)
def _forward_block(begin, count, layers, x, packed, plan, bias_rows, group, work):
    """The first `layers` layers of samples begin to begin + count; results stay in work."""
    last = len(plan) - 1
    first = plan[0]
    _copy_in(x, begin, count, work, 0, first[IN_PAD])
    at, step = 0, first[IN_PAD]
    for layer in range(layers):
        row = plan[layer]
        out_at, out_step = row[HIDDEN], row[OUT_PAD]
        finish = RELU if layer < last else PLAIN
        init, init_at, init_step = packed, row[BIAS], 0
        if layer == 0 and len(bias_rows) > 0:
            bias = packed[row[BIAS] : row[BIAS] + out_step]
            for i in range(count):
                line = work[out_at + i * out_step : out_at + (i + 1) * out_step]
                extra = bias_rows[group[begin + i]]
                for k in range(len(extra)):
                    line[k] = bias[k] + extra[k]
                line[len(extra) :] = 0
            work[out_at + count * out_step : out_at + BLOCK * out_step] = 0
            init, init_at, init_step = work, out_at, out_step
        multiply(BLOCK, row[OUT], row[IN], finish, work, out_at, out_step,
                 init, init_at, init_step, work, at, step, 1,
                 packed, row[FORWARD], out_step, work, out_at, out_step)  # fmt: skip
        at, step = out_at, out_step


@njit(cache=True, nogil=True)
def _forward_samples(start, stop, x, packed, plan, bias_rows, group, out):
    work = _scratch(plan)
    last = plan[-1]
    for begin in range(start, stop, BLOCK):
        count = min(BLOCK, stop - begin)
        _forward_block(begin, count, len(plan), x, packed, plan, bias_rows, group, work)
        _copy_out(work, last[HIDDEN], last[OUT_PAD], out, begin, count)


@njit(cache=True, nogil=True)
def _backward_part(first, end, size, x, packed, plan, bias_rows, group, grad_out, grad_x,
                   sums, spans, group_sums):  # fmt: skip
    work = _scratch(plan)
    slopes = np.zeros_like(work)
    zeros = np.zeros(plan[:, IN_PAD].max(), np.float32)
    last = plan[-1]
    for part in range(first, end):
        stop = min((part + 1) * size, len(x))
        for begin in range(part * size, stop, BLOCK):
            count = min(BLOCK, stop - begin)
            _forward_block(begin, count, len(plan) - 1, x, packed, plan, bias_rows, group, work)
            _copy_in(grad_out, begin, count, slopes, last[HIDDEN], last[OUT_PAD])
            for layer in range(len(plan) - 1, -1, -1):
                row = plan[layer]
                at, step = row[HIDDEN], row[OUT_PAD]
                in_at = plan[layer - 1, HIDDEN] if layer > 0 else 0
                in_step = row[IN_PAD]
                grad_at = row[GRAD_WEIGHT]
                multiply(row[OUT], row[IN], BLOCK, PLAIN, sums[part], grad_at, in_step,
                         sums[part], grad_at, in_step, slopes, at, 1, step,
                         work, in_at, in_step, work, in_at, in_step)  # fmt: skip
                _add_rows(slopes, at, step, count, sums[part], row[GRAD_BIAS])
                if layer > 0 or len(grad_x) > 0:
                    finish = MASKED if layer > 0 else PLAIN
                    multiply(BLOCK, row[IN], row[OUT], finish, slopes, in_at, in_step,
                             zeros, 0, 0, slopes, at, step, 1,
                             packed, row[BACKWARD], in_step, work, in_at, in_step)  # fmt: skip
            if len(bias_rows) > 0:
                row = plan[0]
                low, own = spans[part, 0], spans[part, 1]
                for i in range(count):
                    total = group_sums[own + group[begin + i] - low]
                    line = slopes[row[HIDDEN] + i * row[OUT_PAD] :]
                    for k in range(len(total)):
                        total[k] += line[k]
            if len(grad_x) > 0:
                _copy_out(slopes, 0, plan[0, IN_PAD], grad_x, begin, count)


@njit(cache=True, nogil=True)
def _add_rows(work, at, step, count, total, total_at):
    column = total[total_at : total_at + step]
    for i in range(count):
        line = work[at + i * step : at + (i + 1) * step]
        for k in range(step):
            column[k] += line[k]
