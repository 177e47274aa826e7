"""Small multi-layer perceptrons in plain torch: the oracle, and the path for other devices."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ...errors import InputError
from .encoding import check_indices


def mlp(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    group_bias: Tensor | None = None,
    group: Tensor | None = None,
) -> Tensor:
    """Apply layers y = W x + b with ReLU between them and none after the last: [N,in] -> [N,out].

    weights[i] is [out_i, in_i], biases[i] is [out_i]. Row group[n] of group_bias [G, out_0] is
    added to sample n's first layer before its ReLU: inputs that many samples share (an expression
    a frame, a direction a ray) cost one row instead of a matrix product a sample, exactly.
    """
    check_mlp(x, weights, biases, group_bias, group)
    last = len(weights) - 1
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        x = torch.nn.functional.linear(x, weight, bias)
        if layer == 0 and group_bias is not None and group is not None:
            x = x + group_bias[group.long()]
        if layer < last:
            x = x.relu()
    return x


def check_mlp(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    group_bias: Tensor | None,
    group: Tensor | None,
) -> None:
    """Raise InputError where the layers do not follow one another or a group does not exist."""
    if x.ndim != 2:
        raise InputError(f"mlp: x has shape {tuple(x.shape)}, need [N,in]")
    if not weights or len(weights) != len(biases):
        raise InputError(f"mlp: {len(weights)} weights and {len(biases)} biases")
    width = x.shape[1]
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        if weight.ndim != 2 or weight.shape[1] != width or tuple(bias.shape) != weight.shape[:1]:
            raise InputError(
                f"mlp: layer {layer} gets {width} values, its weight has shape "
                f"{tuple(weight.shape)} and its bias {tuple(bias.shape)}"
            )
        width = weight.shape[0]
    if (group_bias is None) != (group is None):
        raise InputError("mlp: group_bias and group go together; one of them is missing")
    if group_bias is not None and group is not None:
        if group_bias.ndim != 2 or group_bias.shape[1] != weights[0].shape[0]:
            raise InputError(
                f"mlp: group_bias has shape {tuple(group_bias.shape)}, "
                f"need [G,{weights[0].shape[0]}]"
            )
        check_indices("mlp: group", group, len(x), len(group_bias))
