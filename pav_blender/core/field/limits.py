"""Whether a field's numbers stay within float32, whatever is asked of it."""

from __future__ import annotations

import torch

from .field import Field, Mlp

_MOST = 1e37  # float32 ends at 3.4e38
_CONDITION = 1e3  # the largest expression


def overflowing(field: Field) -> str | None:
    """The network whose values may leave float32's range, None where none can.

    What a network is given is at most so large, so what it gives is at most the largest sum of its
    weights times that; its parts take each other's output in turn.
    """
    config = field.config
    tables = _most(field.tables) + _most(getattr(field, "still_tables", field.tables[:0]))
    embedding = _most(field.latent) + _most(field.code)
    geometry = _reach(field.density, tables)
    raw = geometry
    if field.offset is not None:
        raw += _reach(field.offset, embedding + geometry * config.offset_sees_geometry)
    colour = _reach(field.colour, embedding + raw)
    parts = {"tables": tables, "latent": embedding, "density": geometry, "offset": raw}
    for name, reach in (parts | {"colour": colour}).items():
        if not reach <= _MOST:
            return name
    return None


def _reach(network: Mlp, most: float) -> float:
    """The largest value that any layer of a network can have, for inputs up to `most`; infinite or
    not a number where that has no end."""
    group = float(network.group_weight.detach().double().abs().sum(1).max()) * _CONDITION
    largest = 0.0
    for index, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        sums = weight.detach().double().abs().sum(1)
        most = float((sums * most + bias.detach().double().abs()).max()) + group * (index == 0)
        largest += most  # a sum, for `max` would pass over what is not a number
    return largest


def _most(values: torch.Tensor) -> float:
    return float(values.detach().abs().max()) if values.numel() else 0.0
