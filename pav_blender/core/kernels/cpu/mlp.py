"""Small multi-layer perceptrons for the CPU; see `reference/mlp.py`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pav_blender.core.kernels.reference import mlp as reference

CHUNK = 4096  # rows whose hidden values stay in the cache


def mlp(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    group_bias: Tensor | None = None,
    group: Tensor | None = None,
) -> Tensor:
    """As the reference; hidden values are not kept but computed again for the gradient."""
    reference.check_mlp(x, weights, biases, group_bias, group)
    return _Mlp.apply(x, group_bias, group, *weights, *biases)


class _Mlp(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, group_bias: Tensor | None, group: Tensor | None, *layers: Tensor
    ) -> Tensor:
        ctx.save_for_backward(x, group_bias, group, *layers)
        count = len(layers) // 2
        weights, biases = layers[:count], layers[count:]
        out = x.new_empty(len(x), len(biases[-1]))
        for start in range(0, len(x), CHUNK):
            part = slice(start, start + CHUNK)
            out[part] = _hidden(x[part], weights, biases, group_bias, group, part)[-1]
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, group_bias, group, *layers = ctx.saved_tensors
        count = len(layers) // 2
        weights, biases = layers[:count], layers[count:]
        grad_x = torch.empty_like(x)
        grad_group = None if group_bias is None else torch.zeros_like(group_bias)
        grad_weights = [torch.zeros_like(weight) for weight in weights]
        grad_biases = [torch.zeros_like(bias) for bias in biases]
        for start in range(0, len(x), CHUNK):
            part = slice(start, start + CHUNK)
            values = _hidden(x[part], weights, biases, group_bias, group, part)
            slope = grads[0][part]
            for layer in range(count - 1, -1, -1):
                if layer < count - 1:
                    slope = slope * (values[layer + 1] > 0)
                grad_weights[layer].addmm_(slope.t(), values[layer])
                grad_biases[layer] += slope.sum(0)
                if layer == 0 and grad_group is not None:
                    grad_group.index_add_(0, group[part], slope)
                slope = slope @ weights[layer]
            grad_x[part] = slope
        return grad_x, grad_group, None, *grad_weights, *grad_biases


def _hidden(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    group_bias: Tensor | None,
    group: Tensor | None,
    part: slice,
) -> list[Tensor]:
    """What goes into every layer, and what comes out of the last."""
    values = [x]
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        x = torch.addmm(bias, x, weight.t())
        if layer == 0 and group_bias is not None and group is not None:
            x += group_bias.index_select(0, group[part])
        if layer < len(weights) - 1:
            x = x.relu_()
        values.append(x)
    return values
