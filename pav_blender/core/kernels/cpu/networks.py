"""The three networks of a field in one pass over its samples, and one more for all gradients.

A block of samples goes through density, offset and colour while it lies in the cache. Between the
networks there is little arithmetic, but as operations on all samples it takes as long as they do.
Rows of `inputs` hold a sample's embedding and then its geometry, the log-density first, as in
`structures.Frozen`: what the density leaves there offset and colour read.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ...errors import InputError
from ..reference.encoding import check_indices
from .exponential import exp_all
from .mlp import (
    BACKWARD,
    BLOCK,
    CHUNK,
    GRAD_BIAS,
    HIDDEN,
    IN,
    IN_PAD,
    OUT,
    OUT_PAD,
    PARTS,
    add_group_rows,
    add_rows,
    add_weights,
    array_of,
    group_spans,
    pack,
    sum_of_groups,
    sums_size,
    through_layers,
    unpack,
    workspace,
)
from .threads import run_chunks
from .tiles import LANES, MASKED, PLAIN, ROWS, multiply

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract"},
}


class Network(NamedTuple):
    """Weights [out, in] and biases [out] of each layer; what a group of samples adds to the first
    layer [G, hidden]."""

    weights: list[Tensor]
    biases: list[Tensor]
    group_bias: Tensor


def evaluate(
    encoded: Tensor,
    embedding: Tensor,
    distance: Tensor,
    frame: Tensor,
    ray: Tensor,
    density: Network,
    offset: Network | None,
    colour: Network,
    untrained: tuple[float, float, float, float],
    limit: float,
) -> tuple[Tensor, Tensor]:
    """Densities [N] a metre and colours [N, 3] of samples.

    encoded [N, E], best as `encode` leaves it; embedding [N, C]; distance [N] metres; frame [N] and
    ray [N] int32: groups of density and offset, and of the colour. Offset and colour see the
    embedding and what the density answered; the offset's weights of the log-density must be 0.
    untrained and limit as in `structures.Frozen`. Gradients go to all but the distance, and are the
    same for any number of threads.
    """
    count, inputs = len(encoded), embedding.shape[1] + len(density.biases[-1])
    named = {"density": density, "offset": offset, "colour": colour}
    for name, network in named.items():
        width = encoded.shape[1] if name == "density" else inputs
        if network is not None and network.weights[0].shape[1] != width:
            raise InputError(f"evaluate: {name} takes {network.weights[0].shape[1]}, not {width}")
    check_indices("evaluate: frame", frame, count, len(density.group_bias))
    check_indices("evaluate: ray", ray, count, len(colour.group_bias))
    networks = [network for network in named.values() if network is not None]
    parameters = [t for n in networks for t in (n.group_bias, *n.weights, *n.biases)]
    depths = tuple(len(network.biases) for network in networks)
    numbers = np.array([*untrained, limit], np.float32)
    return _Evaluate.apply(encoded, embedding, distance, frame, ray, numbers, depths, *parameters)


class _Evaluate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        encoded: Tensor,
        embedding: Tensor,
        distance: Tensor,
        frame: Tensor,
        ray: Tensor,
        numbers: np.ndarray,
        depths: tuple[int, ...],
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:
        count = len(encoded)
        networks = [_packed(*network) for network in _taken_apart(depths, parameters)]
        samples = _samples(encoded, embedding, distance, frame, ray)
        geometry = torch.empty(count, int(networks[0][0][-1, OUT]))
        sigma, rgb = torch.empty(count), torch.empty(count, 3)
        out = geometry.numpy(), sigma.numpy(), rgb.numpy()
        run_chunks(_forward, count, CHUNK, samples, numbers, *_three(networks), *out)
        ctx.save_for_backward(encoded, embedding, distance, frame, ray, *parameters)
        ctx.known = numbers, networks, samples, out
        return sigma, rgb

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
        numbers, networks, samples, out = ctx.known
        _ = ctx.saved_tensors  # raises where one was changed since
        count, blocks = len(out[1]), -(-len(out[1]) // BLOCK)
        parts = max(1, min(PARTS, blocks // 4))
        size = -(-blocks // parts) * BLOCK
        rows = [bias_rows for _, _, bias_rows in networks]
        which = [samples[3]] * (len(networks) - 1) + [samples[4]]
        spans = [group_spans(group, size, parts) for group in which]
        sums = [np.zeros((parts, sums_size(plan)), np.float32) for plan, _, _ in networks]
        group_sums = [
            np.zeros((int(own[:, 2].sum()), r.shape[1]), np.float32)
            for own, r in zip(spans, rows, strict=True)
        ]
        width = int(networks[0][0][0, IN])
        first = np.zeros((parts, -(-width // ROWS) * ROWS * networks[0][0][0, OUT_PAD]), np.float32)
        grad_x = np.empty(width * count, np.float32)
        grad_embedding = np.empty_like(samples[1])
        slopes = tuple(array_of(grad) for grad in grads)
        run_chunks(
            _backward,
            parts,
            1,
            size,
            samples,
            numbers,
            *_three(networks),
            out,
            slopes,
            first,
            *_three([*zip(sums, spans, group_sums, strict=True)]),
            grad_x,
            grad_embedding,
        )
        found: list[Tensor] = []
        for number, (plan, _, bias_rows) in enumerate(networks):
            weights, biases = unpack(plan, sums[number].sum(0))
            if number == 0:
                weights[0] = _first_weight(first.sum(0), plan[0])
            shape = bias_rows.shape
            found += sum_of_groups(shape, spans[number], group_sums[number]), *weights, *biases
        encoded = torch.from_numpy(grad_x.reshape(width, count)).t()
        nothing = (None,) * 5
        return encoded, torch.from_numpy(grad_embedding), *nothing, *found


def _taken_apart(
    depths: tuple[int, ...], parameters: tuple[Tensor, ...]
) -> list[tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, ...]]]:
    """Group bias, weights and biases of each network."""
    networks, at = [], 0
    for depth in depths:
        middle, end = at + 1 + depth, at + 1 + 2 * depth
        networks.append((parameters[at], parameters[at + 1 : middle], parameters[middle:end]))
        at = end
    return networks


def _packed(
    group_bias: Tensor, weights: tuple[Tensor, ...], biases: tuple[Tensor, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return *pack(weights, biases), array_of(group_bias)


def _three(networks: list[Any]) -> list[Any]:
    """What belongs to density, offset and colour; of an offset that is not there, emptiness."""
    if len(networks) == 3:
        return networks
    empty = tuple(np.zeros((0,) * array.ndim, array.dtype) for array in networks[0])
    return [networks[0], empty, networks[1]]


def _samples(
    encoded: Tensor, embedding: Tensor, distance: Tensor, frame: Tensor, ray: Tensor
) -> tuple[np.ndarray, ...]:
    groups = (group.detach().to(torch.int32).contiguous().numpy() for group in (frame, ray))
    flat = array_of(encoded.t()).reshape(-1)  # feature by feature
    return flat, array_of(embedding), array_of(distance), *groups


def _first_weight(sums: np.ndarray, row: np.ndarray) -> Tensor:
    ins, outs, pad = row[IN], row[OUT], row[OUT_PAD]
    return torch.from_numpy(sums[: ins * pad].reshape(ins, pad)[:, :outs].T.copy())


@njit(**_OPTIONS)
def _features(x, total, width, begin, count, room):
    """Where the features of a block lie one after the other, for products that read whole blocks
    and rows: the array, its first element, from feature to feature."""
    if count == BLOCK and width % ROWS == 0:
        return x, np.int64(begin), np.int64(total)
    for k in range(width):
        line = room[k * BLOCK : (k + 1) * BLOCK]
        line[:count] = x[k * total + begin : k * total + begin + count]
        line[count:] = 0
    return room, np.int64(0), np.int64(BLOCK)


@njit(**_OPTIONS)
def _row_width(channels, answers):
    """Of inputs: products write and read whole vectors."""
    both = -(-(channels + answers) // LANES) * LANES
    return max(both, channels + -(-answers // LANES) * LANES)


@njit(**_OPTIONS)
def _fill(source, source_at, source_step, begin, count, embedding, answers, inputs, wide):
    """Rows of inputs: embeddings and what the density answered, which lies in source."""
    channels = embedding.shape[1]
    for i in range(count):
        row = inputs[i * wide : (i + 1) * wide]
        own = embedding[begin + i]
        for k in range(channels):
            row[k] = own[k]
        line = source[source_at + i * source_step : source_at + i * source_step + answers]
        for k in range(answers):
            row[channels + k] = line[k]
    inputs[count * wide : BLOCK * wide] = 0


@njit(**_OPTIONS)
def _log_density(raw, distance, numbers):
    near = distance / numbers[2] - numbers[3]
    near = np.float32(1) - min(max(near, np.float32(0)), np.float32(1))
    return raw + numbers[0] + near * numbers[1]


@njit(**_OPTIONS)
def _forward(start, stop, samples, numbers, density, offset, colour, geometry, sigma, rgb):
    x, embedding, distance, frame, ray = samples
    plan, packed, bias_rows = density
    offset_plan, offset_packed, offset_rows = offset
    colour_plan, colour_packed, colour_rows = colour
    work, offset_work, colour_work = workspace(plan), workspace(plan), workspace(colour_plan)
    if len(offset_plan) > 0:
        offset_work = workspace(offset_plan)
    total, channels, answers = len(distance), embedding.shape[1], geometry.shape[1]
    wide, width = _row_width(channels, answers), plan[0, IN]
    inputs = np.zeros(BLOCK * wide + ROWS * LANES, np.float32)
    room = np.zeros(-(-width // ROWS) * ROWS * BLOCK, np.float32)
    values = np.zeros(3 * BLOCK, np.float32)
    zero, one, block = np.int64(0), np.int64(1), np.int64(BLOCK)
    last, colour_last = plan[-1], colour_plan[-1]
    for begin in range(start, stop, BLOCK):
        count = min(BLOCK, stop - begin)
        a, at, stride = _features(x, total, width, begin, count, room)
        through_layers(begin, count, block, len(plan), a, at, one, stride,
                       packed, plan, bias_rows, frame, work)  # fmt: skip
        _fill(work, last[HIDDEN], last[OUT_PAD], begin, count, embedding, answers, inputs, wide)
        if len(offset_plan) > 0:
            through_layers(begin, count, block, len(offset_plan), inputs, zero, wide, one,
                           offset_packed, offset_plan, offset_rows, frame,
                           offset_work)  # fmt: skip
            at, step = offset_plan[-1, HIDDEN], offset_plan[-1, OUT_PAD]
            for i in range(count):
                inputs[i * wide + channels] += offset_work[at + i * step]
        for i in range(count):
            found = _log_density(inputs[i * wide + channels], distance[begin + i], numbers)
            values[i] = numbers[4] if found > numbers[4] else found
        exp_all(values, count)
        for i in range(count):
            sigma[begin + i] = values[i] * np.float32(1e3)
        through_layers(begin, count, block, len(colour_plan), inputs, zero, wide, one,
                       colour_packed, colour_plan, colour_rows, ray, colour_work)  # fmt: skip
        at, step = colour_last[HIDDEN], colour_last[OUT_PAD]
        for i in range(count):
            for k in range(3):
                values[3 * i + k] = -colour_work[at + i * step + k]
        exp_all(values, 3 * count)
        for i in range(count):
            for k in range(3):
                rgb[begin + i, k] = np.float32(1) / (np.float32(1) + values[3 * i + k])
            row = inputs[i * wide + channels : (i + 1) * wide]
            for k in range(answers):
                geometry[begin + i, k] = row[k]


@njit(**_OPTIONS)
def _layers_back(count, plan, packed, work, slopes, sums, zeros):
    """From the slopes of a network's outputs to those of its first layer's, and the gradients of
    weights and biases on the way, but for the first weight's."""
    zero, one, block = np.int64(0), np.int64(1), np.int64(BLOCK)
    masked = np.int64(MASKED)
    for layer in range(len(plan) - 1, -1, -1):
        row = plan[layer]
        at, step, in_step = row[HIDDEN], row[OUT_PAD], row[IN_PAD]
        add_rows(slopes, at, step, count, sums, row[GRAD_BIAS])
        if layer > 0:
            in_at = plan[layer - 1, HIDDEN]
            add_weights(count, row, slopes, work, in_at, in_step, sums)
            multiply(block, row[IN], row[OUT], masked, slopes, in_at, in_step,
                     zeros, zero, zero, slopes, at, step, one,
                     packed, row[BACKWARD], in_step, work, in_at, in_step)  # fmt: skip


@njit(**_OPTIONS)
def _inputs_back(row, packed, inputs, wide, slopes, sums, init, init_step, grad_inputs):
    """The first layer's part of it for offset and colour, whose inputs are the same rows."""
    zero, one, block = np.int64(0), np.int64(1), np.int64(BLOCK)
    plain, at, step, in_step = np.int64(PLAIN), row[HIDDEN], row[OUT_PAD], row[IN_PAD]
    add_weights(block, row, slopes, inputs, zero, wide, sums)
    multiply(block, row[IN], row[OUT], plain, grad_inputs, zero, wide,
             init, zero, init_step, slopes, at, step, one,
             packed, row[BACKWARD], in_step, inputs, zero, wide)  # fmt: skip


@njit(**_OPTIONS)
def _backward(first_part, end_part, size, samples, numbers, density, offset, colour, out, grads,
              first, density_sums, offset_sums, colour_sums, grad_x, grad_embedding):  # fmt: skip
    x, embedding, distance, frame, ray = samples
    plan, packed, bias_rows = density
    offset_plan, offset_packed, offset_rows = offset
    colour_plan, colour_packed, colour_rows = colour
    geometry, sigma, rgb = out
    grad_sigma, grad_rgb = grads
    work, colour_work = workspace(plan), workspace(colour_plan)
    offset_work = workspace(offset_plan) if len(offset_plan) > 0 else workspace(plan)
    slopes, offset_slopes = np.zeros_like(work), np.zeros_like(offset_work)
    colour_slopes = np.zeros_like(colour_work)
    total, channels, answers = len(distance), embedding.shape[1], geometry.shape[1]
    wide, width = _row_width(channels, answers), plan[0, IN]
    inputs = np.zeros(BLOCK * wide + ROWS * LANES, np.float32)
    grad_inputs = np.zeros_like(inputs)
    room = np.zeros(-(-width // ROWS) * ROWS * BLOCK, np.float32)
    features = np.zeros(BLOCK * plan[0, IN_PAD] + ROWS * LANES, np.float32)
    zeros = np.zeros(max(wide, plan[:, IN_PAD].max(), colour_plan[:, IN_PAD].max()), np.float32)
    if len(offset_plan) > 0 and offset_plan[:, IN_PAD].max() > len(zeros):
        zeros = np.zeros(offset_plan[:, IN_PAD].max(), np.float32)
    zero, one, block, plain = np.int64(0), np.int64(1), np.int64(BLOCK), np.int64(PLAIN)
    flat = geometry.ravel()
    for part in range(first_part, end_part):
        for begin in range(part * size, min((part + 1) * size, total), BLOCK):
            count = min(BLOCK, min((part + 1) * size, total) - begin)
            a, a_at, a_stride = _features(x, total, width, begin, count, room)
            through_layers(begin, count, block, len(plan) - 1, a, a_at, one, a_stride,
                           packed, plan, bias_rows, frame, work)  # fmt: skip
            _fill(flat, begin * answers, answers, begin, count, embedding, answers, inputs, wide)
            through_layers(begin, count, block, len(colour_plan) - 1, inputs, zero, wide, one,
                           colour_packed, colour_plan, colour_rows, ray, colour_work)  # fmt: skip

            at, step = colour_plan[-1, HIDDEN], colour_plan[-1, OUT_PAD]
            for i in range(count):
                for k in range(3):
                    y = rgb[begin + i, k]
                    slope = grad_rgb[begin + i, k] * y * (np.float32(1) - y)
                    colour_slopes[at + i * step + k] = slope
            colour_slopes[at + count * step : at + BLOCK * step] = 0
            _layers_back(count, colour_plan, colour_packed, colour_work, colour_slopes,
                         colour_sums[0][part], zeros)  # fmt: skip
            _inputs_back(colour_plan[0], colour_packed, inputs, wide, colour_slopes,
                         colour_sums[0][part], zeros, zero, grad_inputs)  # fmt: skip
            add_group_rows(begin, count, colour_plan[0], ray, colour_slopes,
                           colour_sums[1][part], colour_sums[2])  # fmt: skip

            for i in range(count):
                raw = inputs[i * wide + channels]
                if _log_density(raw, distance[begin + i], numbers) <= numbers[4]:
                    slope = grad_sigma[begin + i] * sigma[begin + i]
                    grad_inputs[i * wide + channels] += slope
            if len(offset_plan) > 0:
                through_layers(begin, count, block, len(offset_plan) - 1, inputs, zero, wide, one,
                               offset_packed, offset_plan, offset_rows, frame,
                               offset_work)  # fmt: skip
                at, step = offset_plan[-1, HIDDEN], offset_plan[-1, OUT_PAD]
                for i in range(BLOCK):
                    offset_slopes[at + i * step] = grad_inputs[i * wide + channels]
                _layers_back(count, offset_plan, offset_packed, offset_work, offset_slopes,
                             offset_sums[0][part], zeros)  # fmt: skip
                _inputs_back(offset_plan[0], offset_packed, inputs, wide, offset_slopes,
                             offset_sums[0][part], grad_inputs, wide, grad_inputs)  # fmt: skip
                add_group_rows(begin, count, offset_plan[0], frame, offset_slopes,
                               offset_sums[1][part], offset_sums[2])  # fmt: skip

            at, step = plan[-1, HIDDEN], plan[-1, OUT_PAD]
            for i in range(BLOCK):
                row = grad_inputs[i * wide + channels : i * wide + channels + answers]
                for k in range(answers):
                    slopes[at + i * step + k] = row[k]
            _layers_back(count, plan, packed, work, slopes, density_sums[0][part], zeros)
            add_group_rows(begin, count, plan[0], frame, slopes, density_sums[1][part],
                           density_sums[2])  # fmt: skip
            row, at, step, in_step = plan[0], plan[0, HIDDEN], plan[0, OUT_PAD], plan[0, IN_PAD]
            multiply(width, row[OUT], block, plain, first[part], zero, step,
                     first[part], zero, step, a, a_at, a_stride, one,
                     slopes, at, step, slopes, at, step)  # fmt: skip
            multiply(block, width, row[OUT], plain, features, zero, in_step,
                     zeros, zero, zero, slopes, at, step, one,
                     packed, row[BACKWARD], in_step, slopes, at, step)  # fmt: skip
            for k in range(width):
                line = grad_x[k * total + begin : k * total + begin + count]
                for i in range(count):
                    line[i] = features[i * in_step + k]
            for i in range(count):
                line = grad_inputs[i * wide : i * wide + channels]
                for k in range(channels):
                    grad_embedding[begin + i, k] = line[k]
