"""A field held still, in whichever of two ways compiled code was given it: `frozen` or, in
bfloat16, `frozen_pairs`. numba chooses by the types of what `arrays_of` made."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numba.extending import overload

from ..structures import Frozen
from . import frozen, frozen_pairs
from .frozen_pairs import short_tables
from .search import INLINE

__all__ = ["arrays_of", "short_tables"]

_OPTIONS: Any = INLINE


def arrays_of(field: Frozen, short: tuple[np.ndarray, np.ndarray] | None = None) -> tuple[Any, ...]:
    """What compiled functions are told of a field: encodings, density and offset, colour, latent,
    the numbers of an untrained density, and how appearances mix. short: the encodings' tables as
    `short_tables` made them, for all in bfloat16; else it is float32."""
    if short is None or not frozen_pairs.fits(field):
        return frozen.arrays_of(field)
    return frozen_pairs.arrays_of(field, short)


def _of(field: Any) -> Any:
    """The module that made a field, by its type: a network in pairs has three parts, not two."""
    network = field[1][0]
    assert isinstance(network, types.BaseTuple)
    return frozen_pairs if len(network) == 3 else frozen


def features_for(field, most): ...


def inputs_for(field, count): ...


def shading_room(field): ...


def densities(start, stop, field, mesh_corners, samples, features, inputs, sigma, parts): ...


def shade(count, base, views, field, inputs, shown, shown_row, shown_weight, room, out): ...


@overload(features_for, jit_options=_OPTIONS)
def _features_for(field, most):
    chosen = _of(field).features_for
    return lambda field, most: chosen(field, most)


@overload(inputs_for, jit_options=_OPTIONS)
def _inputs_for(field, count):
    chosen = _of(field).inputs_for
    return lambda field, count: chosen(field, count)


@overload(shading_room, jit_options=_OPTIONS)
def _shading_room(field):
    chosen = _of(field).shading_room
    return lambda field: chosen(field)


@overload(densities, jit_options=_OPTIONS)
def _densities(start, stop, field, mesh_corners, samples, features, inputs, sigma, parts):
    chosen = _of(field).densities

    def run(start, stop, field, mesh_corners, samples, features, inputs, sigma, parts):
        chosen(start, stop, field, mesh_corners, samples, features, inputs, sigma, parts)

    return run


@overload(shade, jit_options=_OPTIONS)
def _shade(count, base, views, field, inputs, shown, shown_row, shown_weight, room, out):
    chosen = _of(field).shade

    def run(count, base, views, field, inputs, shown, shown_row, shown_weight, room, out):
        chosen(count, base, views, field, inputs, shown, shown_row, shown_weight, room, out)

    return run
