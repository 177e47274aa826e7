"""Small multi-layer perceptrons for the CPU; see `reference/mlp.py`.

Blocks of samples go through all layers while they lie in the first cache. Rows stay rows: a layer
is `init + x @ W^T` for a few dozen samples at a time, and its two gradients are products of the
same kind, so one routine (`tiles.multiply`) does everything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
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
# Columns of a plan, one row a layer: sizes, sizes rounded up to LANES, where things begin, and
# whether the weights' gradient is kept [in, out], because tiles fit that better.
IN, OUT, IN_PAD, OUT_PAD, FORWARD, BIAS, BACKWARD, HIDDEN, GRAD_WEIGHT, GRAD_BIAS = range(10)
TURNED = 10
FEW = 3  # outputs of a layer of which a product's tiles, rows of them, would be mostly surplus


def mlp(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    group_bias: Tensor | None = None,
    group: Tensor | None = None,
) -> Tensor:
    """As the reference, in float32; hidden values are not kept but computed again for gradients.

    x may lie in memory row by row or, as `encode` leaves it, feature by feature.
    """
    reference.check_mlp(x, weights, biases, group_bias, group)
    return _Mlp.apply(x, group_bias, group, *weights, *biases)


@dataclass(frozen=True)
class Gradients:
    """What `mlp_backward` returns; x only where it was asked for, laid out as the input was."""

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
    plan, packed = pack(weights, biases)
    count = len(x)
    blocks = -(-count // BLOCK)
    parts = max(1, min(PARTS, blocks // 4))
    size = -(-blocks // parts) * BLOCK
    sums = np.zeros((parts, sums_size(plan)), np.float32)
    values, turned = _rows(x)
    grad_x = torch.empty(values.shape if need_x else (0, 0))
    bias_rows, which = _group_arrays(group_bias, group)
    spans = group_spans(which, size, parts)
    group_sums = np.zeros((int(spans[:, 2].sum()), bias_rows.shape[1]), np.float32)
    run_chunks(
        _backward_parts,
        parts,
        1,
        size,
        values,
        turned,
        packed,
        plan,
        bias_rows,
        which,
        array_of(grad_out),
        grad_x.numpy(),
        sums,
        spans,
        group_sums,
    )
    grad_weights, grad_biases = unpack(plan, sums.sum(0))
    grad_group = None
    if group_bias is not None:
        grad_group = sum_of_groups(tuple(group_bias.shape), spans, group_sums)
    if turned:
        grad_x = grad_x.t()
    return Gradients(grad_x if need_x else None, grad_weights, grad_biases, grad_group)


class _Mlp(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, group_bias: Tensor | None, group: Tensor | None, *layers: Tensor
    ) -> Tensor:
        ctx.save_for_backward(x, group_bias, group, *layers)
        half = len(layers) // 2
        plan, packed = pack(layers[:half], layers[half:])
        out = torch.empty(len(x), len(layers[-1]))
        arrays = (*_rows(x), packed, plan, *_group_arrays(group_bias, group), out.numpy())
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


@lru_cache(maxsize=64)
def _plan(sizes: tuple[int, ...]) -> np.ndarray:
    """Where everything of a network lies: [layers, 11] int64."""
    plan = np.zeros((len(sizes) - 1, 11), np.int64)
    at = sums = 0
    hidden = BLOCK * _padded(sizes[0])  # after the inputs
    for row, ins, outs in zip(plan, sizes[:-1], sizes[1:], strict=True):
        in_pad, out_pad = _padded(ins), _padded(outs)
        bias = at + ins * out_pad
        upright = -(-outs // ROWS) * ROWS * in_pad
        lying = -(-ins // ROWS) * ROWS * out_pad
        turned = outs > FEW and lying < upright
        grad_bias = sums + (lying if turned else upright)
        places = at, bias, bias + out_pad, hidden, sums, grad_bias
        row[:] = ins, outs, in_pad, out_pad, *places, turned
        at = bias + out_pad + outs * in_pad
        hidden += BLOCK * out_pad
        sums = grad_bias + out_pad
    return plan


def sums_size(plan: np.ndarray) -> int:
    return int(plan[-1, GRAD_BIAS] + plan[-1, OUT_PAD])


def pack(weights: Sequence[Tensor], biases: Sequence[Tensor]) -> tuple[np.ndarray, np.ndarray]:
    """The plan, and in one array all weights as `tiles.multiply` wants them: padded, both ways."""
    plan = _plan((weights[0].shape[1], *(len(bias) for bias in biases)))
    last = plan[-1]
    packed = np.zeros(last[BACKWARD] + last[OUT] * last[IN_PAD], np.float32)
    for row, weight, bias in zip(plan, weights, biases, strict=True):
        _pack_layer(array_of(weight), array_of(bias), row, packed)
    return plan, packed


def unpack(plan: np.ndarray, sums: np.ndarray) -> tuple[list[Tensor], list[Tensor]]:
    """Gradients of weights and biases from the sums of all layers."""
    weights, biases = [], []
    for row in plan:
        ins, outs, begin = row[IN], row[OUT], row[GRAD_WEIGHT]
        if row[TURNED]:
            weight = sums[begin : begin + ins * row[OUT_PAD]].reshape(ins, -1)[:, :outs].T
        else:
            weight = sums[begin : begin + outs * row[IN_PAD]].reshape(outs, -1)[:, :ins]
        weights.append(torch.from_numpy(weight.copy()))
        biases.append(torch.from_numpy(sums[row[GRAD_BIAS] : row[GRAD_BIAS] + outs].copy()))
    return weights, biases


def _padded(size: int) -> int:
    return -(-size // LANES) * LANES


def _rows(x: Tensor) -> tuple[np.ndarray, bool]:
    """The inputs as an array [N,in], or [in,N] and True where they lie feature by feature."""
    turned = not x.is_contiguous() and x.t().is_contiguous()
    return array_of(x.t() if turned else x), turned


def _group_arrays(group_bias: Tensor | None, group: Tensor | None) -> tuple[np.ndarray, np.ndarray]:
    if group_bias is None or group is None:
        return np.zeros((0, 0), np.float32), np.zeros(0, np.int32)
    return array_of(group_bias), group.detach().to(torch.int32).contiguous().numpy()


def group_spans(which: np.ndarray, size: int, parts: int) -> np.ndarray:
    """Lowest group, first row of its own sums, and number of rows, for every part.

    Groups mostly come in order (rays, frames), so that the parts' sums barely overlap.
    """
    spans = np.zeros((parts, 3), np.int64)
    at = 0
    for part in range(parts):
        mine = which[part * size : (part + 1) * size]
        if len(mine):
            low, high = int(mine.min()), int(mine.max())
            spans[part] = low, at, high - low + 1
            at += high - low + 1
    return spans


def sum_of_groups(shape: tuple[int, ...], spans: np.ndarray, group_sums: np.ndarray) -> Tensor:
    """The parts' sums together [G, hidden]; spans as `group_spans`."""
    summed = np.zeros(shape, np.float32)
    for low, at, length in spans:
        summed[low : low + length] += group_sums[at : at + length]
    return torch.from_numpy(summed)


def array_of(tensor: Tensor) -> Any:
    if tensor.device.type != "cpu" or tensor.dtype != torch.float32:
        raise InputError(
            f"CPU kernels work on float32 in main memory, not on {tensor.dtype} on {tensor.device}"
        )
    return tensor.detach().contiguous().numpy()


@njit(cache=True, nogil=True)
def _pack_layer(weight, bias, row, packed):
    ins, outs, in_pad, out_pad = row[IN], row[OUT], row[IN_PAD], row[OUT_PAD]
    forward, backward = row[FORWARD], row[BACKWARD]
    for o in range(outs):
        packed[row[BIAS] + o] = bias[o]
        for i in range(ins):
            packed[forward + i * out_pad + o] = weight[o, i]
            packed[backward + o * in_pad + i] = weight[o, i]


@njit(cache=True, nogil=True)
def workspace(plan):
    """Room for a block's inputs and the results of all layers; products may read a little past."""
    last = plan[-1]
    return np.zeros(last[HIDDEN] + BLOCK * last[OUT_PAD] + ROWS * LANES, np.float32)


@njit(cache=True, nogil=True)
def _copy_in(source, turned, begin, count, work, at, step):
    """Samples of source as rows of work; what is left of the block becomes zero."""
    width = len(source) if turned else source.shape[1]
    if turned:
        for k in range(width):
            line = source[k, begin : begin + count]
            for i in range(count):
                work[at + i * step + k] = line[i]
    else:
        for i in range(count):
            row = work[at + i * step : at + i * step + width]
            for k in range(width):
                row[k] = source[begin + i, k]
    if width < step:
        for i in range(count):
            work[at + i * step + width : at + (i + 1) * step] = 0
    work[at + count * step : at + BLOCK * step] = 0


@njit(cache=True, nogil=True)
def _copy_out(work, at, step, target, turned, begin, count):
    if turned:
        for k in range(len(target)):
            line = target[k, begin : begin + count]
            for i in range(count):
                line[i] = work[at + i * step + k]
    else:
        for i in range(count):
            row = work[at + i * step : at + (i + 1) * step]
            for k in range(target.shape[1]):
                target[begin + i, k] = row[k]


@njit(cache=True, nogil=True)
def _group_rows(begin, count, row, packed, bias_rows, group, work):
    """What the first layer's sums begin with: its bias plus that of every sample's group."""
    at, step = row[HIDDEN], row[OUT_PAD]
    bias = packed[row[BIAS] : row[BIAS] + step]
    for i in range(count):
        line = work[at + i * step : at + (i + 1) * step]
        extra = bias_rows[group[begin + i]]
        for k in range(len(extra)):
            line[k] = bias[k] + extra[k]
        for k in range(len(extra), step):
            line[k] = 0
    work[at + count * step : at + BLOCK * step] = 0


@njit(cache=True, nogil=True)
def through_layers(begin, count, rows, layers, x, x_at, x_step, x_stride,
            packed, plan, bias_rows, group, work):  # fmt: skip
    """The first `layers` layers of `rows` samples, of which `count` are real; results in work.

    The inputs x are walked as `a` of a product.
    """
    a, at, step, stride = x, x_at, x_step, x_stride
    for layer in range(layers):
        row = plan[layer]
        out_at, out_step = row[HIDDEN], row[OUT_PAD]
        finish = RELU if layer < len(plan) - 1 else PLAIN
        init, init_at, init_step = packed, row[BIAS], np.int64(0)
        if layer == 0 and len(bias_rows) > 0:
            _group_rows(begin, count, row, packed, bias_rows, group, work)
            init, init_at, init_step = work, out_at, out_step
        multiply(rows, row[OUT], row[IN], finish, work, out_at, out_step,
                 init, init_at, init_step, a, at, step, stride,
                 packed, row[FORWARD], out_step, work, out_at, out_step)  # fmt: skip
        a, at, step, stride = work, out_at, out_step, np.int64(1)


# Below, constants that are passed on have a type of their own: numba would compile what they are
# passed to once more for every value.


@njit(cache=True, nogil=True)
def _forward_samples(start, stop, x, turned, packed, plan, bias_rows, group, out):
    work = workspace(plan)
    zero, no = np.int64(0), np.bool_(False)
    flat = x.ravel()
    first, last = plan[0], plan[-1]
    for begin in range(start, stop, BLOCK):
        count = min(BLOCK, stop - begin)
        if count < BLOCK:
            # Tiles are read whole, so that samples past the end must exist.
            _copy_in(x, turned, begin, count, work, zero, first[IN_PAD])
            a, at, step, stride = work, 0, first[IN_PAD], 1
        elif turned:
            a, at, step, stride = flat, begin, 1, x.shape[1]
        else:
            a, at, step, stride = flat, begin * first[IN], first[IN], 1
        through_layers(begin, count, count, len(plan), a, at, step, stride,
                packed, plan, bias_rows, group, work)  # fmt: skip
        _copy_out(work, last[HIDDEN], last[OUT_PAD], out, no, begin, count)


@njit(cache=True, nogil=True)
def _backward_parts(first, end, size, x, turned, packed, plan, bias_rows, group, grad_out, grad_x,
                    sums, spans, group_sums):  # fmt: skip
    work = workspace(plan)
    slopes = np.zeros_like(work)
    zero, one, block = np.int64(0), np.int64(1), np.int64(BLOCK)
    no = np.bool_(False)
    zeros = np.zeros(plan[:, IN_PAD].max(), np.float32)
    start, last = plan[0], plan[-1]
    total = len(grad_out)
    for part in range(first, end):
        stop = min((part + 1) * size, total)
        for begin in range(part * size, stop, BLOCK):
            count = min(BLOCK, stop - begin)
            _copy_in(x, turned, begin, count, work, zero, start[IN_PAD])
            through_layers(begin, count, block, len(plan) - 1, work, zero, start[IN_PAD], one,
                    packed, plan, bias_rows, group, work)  # fmt: skip
            _copy_in(grad_out, no, begin, count, slopes, last[HIDDEN], last[OUT_PAD])
            for layer in range(len(plan) - 1, -1, -1):
                row = plan[layer]
                at, step = row[HIDDEN], row[OUT_PAD]
                in_at = plan[layer - 1, HIDDEN] if layer > 0 else 0
                in_step = row[IN_PAD]
                add_weights(count, row, slopes, work, in_at, in_step, sums[part])
                add_rows(slopes, at, step, count, sums[part], row[GRAD_BIAS])
                if layer > 0 or len(grad_x) > 0:
                    finish = MASKED if layer > 0 else PLAIN
                    multiply(block, row[IN], row[OUT], finish, slopes, in_at, in_step,
                             zeros, zero, zero, slopes, at, step, one,
                             packed, row[BACKWARD], in_step, work, in_at, in_step)  # fmt: skip
            if len(bias_rows) > 0:
                add_group_rows(begin, count, start, group, slopes, spans[part], group_sums)
            if len(grad_x) > 0:
                _copy_out(slopes, zero, start[IN_PAD], grad_x, turned, begin, count)


@njit(cache=True, nogil=True)
def add_weights(count, row, slopes, x, x_at, x_step, sums):
    """Add the gradient of a layer's weights, from a block's slopes and inputs, to sums."""
    block, one, plain = np.int64(BLOCK), np.int64(1), np.int64(PLAIN)
    at, step, grad_at = row[HIDDEN], row[OUT_PAD], row[GRAD_WEIGHT]
    if row[OUT] <= FEW:
        for i in range(count):
            line = x[x_at + i * x_step : x_at + i * x_step + row[IN]]
            for k in range(row[OUT]):
                slope = slopes[at + i * step + k]
                total = sums[grad_at + k * row[IN_PAD] : grad_at + (k + 1) * row[IN_PAD]]
                for j in range(len(line)):
                    total[j] += slope * line[j]
    elif row[TURNED]:
        multiply(row[IN], row[OUT], block, plain, sums, grad_at, step,
                 sums, grad_at, step, x, x_at, one, x_step,
                 slopes, at, step, slopes, at, step)  # fmt: skip
    else:
        multiply(row[OUT], row[IN], block, plain, sums, grad_at, row[IN_PAD],
                 sums, grad_at, row[IN_PAD], slopes, at, one, step,
                 x, x_at, x_step, x, x_at, x_step)  # fmt: skip


@njit(cache=True, nogil=True)
def add_group_rows(begin, count, row, group, slopes, span, group_sums):
    """Add the slopes of a first layer to the sums of the samples' groups; span as `group_spans`."""
    own = span[1] - span[0]
    for i in range(count):
        target = group_sums[own + group[begin + i]]
        at = row[HIDDEN] + i * row[OUT_PAD]
        line = slopes[at : at + len(target)]
        for k in range(len(target)):
            target[k] += line[k]


@njit(cache=True, nogil=True)
def add_rows(work, at, step, count, total, total_at):
    """Add `count` rows of work to one another, and to total."""
    column = total[total_at : total_at + step]
    for i in range(count):
        line = work[at + i * step : at + (i + 1) * step]
        for k in range(step):
            column[k] += line[k]
