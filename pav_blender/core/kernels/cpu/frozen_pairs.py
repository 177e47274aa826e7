"""`frozen` where the processor multiplies pairs of bfloat16 numbers (`pairs`): the same functions.

Tables are in bfloat16, and what networks see of a sample: the embedding, then log-density and
geometry, each from an even place on. Log-densities and densities stay float32.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ..structures import Frozen
from . import corners, pairs, rows
from .frozen import (
    DISTANCE,
    RESTING,
    ROOM,
    add_colours,
    embedding_rows,
    encode,
    encodings_of,
    latent_of,
    mix,
    mixing_of,
    to_densities,
    untrained,
    untrained_of,
)
from .mlp import BLOCK
from .pairs import OUT, OUT_PAD, shorten, shorten_row, through_layers
from .search import INLINE
from .tiles import LANES


def fits(field: Frozen) -> bool:
    """Whether this processor and the numbers of a field's networks allow for it."""
    layers = (field.density, field.offset, field.colour)
    return pairs.available() and all(pairs.fit(network) for network in layers)


def short_tables(field: Frozen) -> tuple[np.ndarray, np.ndarray] | None:
    """The tables of both encodings in bfloat16, the two features of an entry in an int32; None
    where the processor or the numbers do not allow for it."""
    found = [tables for tables, _ in field.encodings]
    if not pairs.available() or not all(pairs.small(tables) for tables in found):
        return None
    short = [pairs.rounded(tables.detach().numpy()).reshape(-1).view(np.int32) for tables in found]
    return short[0], short[1] if len(short) > 1 else np.zeros(0, np.int32)


def arrays_of(field: Frozen, short: tuple[np.ndarray, np.ndarray]) -> tuple[Any, ...]:
    """As `frozen.arrays_of`, with tables as `short_tables` makes them."""
    embedding, geometry = field.latent.shape[-1], len(field.density.biases[-1])
    seen = np.arange(embedding + geometry)
    seen[embedding:] += embedding % 2
    return (
        tuple((t, levels) for t, (_, levels) in zip(short, encodings_of(field), strict=True)),
        (
            pairs.pack(field.density),
            pairs.pack(field.offset, seen),
            field.offset is not None,
        ),
        pairs.pack(field.colour, seen),
        latent_of(field),
        untrained_of(field),
        mixing_of(field),
    )


@njit(**INLINE)
def columns_of(field):
    """How many numbers a sample has in `inputs`."""
    embedding, geometry = field[3][1], field[1][0][0][-1, OUT]
    return embedding + embedding % 2 + geometry + geometry % 2


@njit(**INLINE)
def features_for(field, most):
    return np.zeros((field[1][0][0][0, 0] + 1, most + ROOM), np.int32)


@njit(**INLINE)
def inputs_for(field, count):
    # rows are written sixteen numbers at a time
    return np.zeros(count * columns_of(field) + LANES, np.int16)


@njit(**INLINE)
def shading_room(field):
    """What `shade` needs to work in."""
    lit = np.zeros((BLOCK + ROOM) * columns_of(field) // 2, np.int32)
    return lit, pairs.workspace(field[2][0])


@njit(**INLINE)
def densities(start, stop, field, mesh_corners, samples, features, inputs, sigma, parts):
    """As `frozen.densities`."""
    encodings, networks, _, latent, numbers, mixing = field
    count, room = mixing[0], len(sigma)
    of_one = len(latent[0]) // count // max(latent[1], 1)
    triangle, places = samples
    corner_scratch = (
        np.zeros(3 * corners.BLOCK, np.float32),
        np.zeros(8 * corners.STRIDE, np.int32),
        np.zeros(8 * corners.STRIDE, np.float32),
    )
    index, weight = np.zeros(4 * rows.STRIDE, np.int64), np.zeros(4 * rows.STRIDE, np.float32)
    density, offset, has_offset = networks
    density_work, offset_work = pairs.workspace(density[0]), pairs.workspace(offset[0])
    geometry, wide = density[0][-1, OUT], density[0][-1, OUT_PAD]
    columns = columns_of(field)
    half = columns // 2
    first = latent[1] + latent[1] % 2  # the log-density's place
    no_rows, no_group = np.zeros(0, np.float32), np.zeros(0, np.int32)
    logs = np.zeros(BLOCK + LANES, np.float32)
    zero, one = np.int64(0), np.int64(1)
    seen, in_pairs = features.ravel(), inputs[: len(inputs) // 2 * 2].view(np.int32)
    halves, step = seen.view(np.int16), features.shape[1]
    steps, rest = (2 * step, np.int64(2), one), 2 * step * len(encodings[0][1])
    encode(encodings[0], places, 0, start, stop - start, halves, zero, steps, corner_scratch)
    encode(encodings[1], places, RESTING, start, stop - start, halves, rest, steps, corner_scratch)
    for begin in range(start, stop, BLOCK):
        n = min(BLOCK, stop - begin)
        through_layers(zero, n, seen, begin - start, one, step, density, no_rows,
                       no_group, density_work)  # fmt: skip
        found = density_work[2]
        for k in range(count):
            row = k * room + begin
            for i in range(n):  # what runs over a row's end is the next one's, written after it
                for channel in range(0, geometry, LANES):
                    shorten_row(found, i * wide + channel, inputs,
                                (row + i) * columns + first + channel)  # fmt: skip
                if geometry % 2:
                    inputs[(row + i) * columns + first + geometry] = 0
            embedding_rows(latent, k * of_one, mesh_corners, triangle, places, begin, n, index,
                           weight, inputs, row, columns)  # fmt: skip
            if latent[1] % 2:
                for i in range(n):
                    inputs[(row + i) * columns + latent[1]] = 0
            if has_offset:
                through_layers(zero, n, in_pairs, row * half, half, one, offset, no_rows, no_group,
                               offset_work)  # fmt: skip
            for i in range(n):
                raw = found[i * wide]
                if has_offset:
                    raw += offset_work[2][i * offset[0][-1, OUT_PAD]]
                    shorten(raw, inputs, (row + i) * columns + first)
                raw += untrained(places[DISTANCE, begin + i], numbers)
                logs[i] = min(raw, numbers[4])
            if count == 1:
                to_densities(logs, n, sigma, begin)
            else:
                to_densities(logs, n, parts, row)
    if count > 1:
        mix(start, stop, mixing, places, parts, sigma)


@njit(**INLINE)
def shade(count, base, views, field, inputs, shown, shown_row, shown_weight, room, out):
    """As `frozen.shade`."""
    colour = field[2]
    lit, work = room
    half = columns_of(field) // 2
    wide = colour[0][-1, OUT_PAD]
    zero, one = np.int64(0), np.int64(1)
    group = views[base:].reshape(-1)
    source = inputs[: len(inputs) // 2 * 2].view(np.int32)
    for begin in range(0, count, BLOCK):
        n = min(BLOCK, count - begin)
        for i in range(n):
            at = shown[begin + i] * half
            for k in range(half):
                lit[i * half + k] = source[at + k]
        through_layers(begin, n, lit, zero, half, one, colour, group, shown_row, work)
        add_colours(work[2], wide, n, begin, base, shown_row, shown_weight, out)
