"""A field held still (`structures.Frozen`) inside compiled functions that run whole rays.

Encoding, embedding and networks of a few hundred samples while they lie in the cache, one after the
other as `field.Field` has them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit

from ..structures import Frozen, Layers
from . import corners, rows
from .encoding import level_array
from .marching import flat, rows_of
from .mlp import BLOCK, HIDDEN, OUT, OUT_PAD, pack, through_layers, workspace
from .search import INLINE

# rows of a sample's places: canonical in the unit box, resting with the shoulders, barycentrics,
# distance from the mesh
RESTING, WEIGHTS, DISTANCE, PLACES = 3, 6, 9, 10
ROOM = corners.BLOCK  # samples past the last that a block may touch


def arrays_of(field: Frozen) -> tuple[Any, ...]:
    """What compiled functions are told of a field: encodings, density and offset, colour, latent,
    and the numbers of an untrained density."""
    return (
        _encodings(field),
        (_packed(field.density), _packed(field.offset), field.offset is not None),
        _packed(field.colour),
        _latent(field),
        np.array([*field.untrained, field.limit], np.float32),
    )


def _encodings(field: Frozen) -> tuple[Any, Any]:
    """Tables and levels of the canonical and of the resting place, which may have none."""
    found = [
        (rows_of(tables, np.float32).reshape(-1), level_array(layout))
        for tables, layout in field.encodings
    ]
    nothing = np.zeros(0, np.float32), np.zeros((0, 4), np.int64)
    return found[0], (found[1] if len(found) > 1 else nothing)


def _packed(layers: Layers | None) -> tuple[np.ndarray, np.ndarray]:
    weights, biases = layers or ([torch.zeros(1, 1)], [torch.zeros(1)])
    return pack(weights, biases)


def _latent(field: Frozen) -> tuple[Any, ...]:
    """The latent features in a row, their number, texels a side (0: at vertices), corners' UVs."""
    width = field.latent.shape[-1]
    side = field.latent.shape[0] if len(field.corner_uvs) else 0
    return rows_of(field.latent, np.float32).reshape(-1), width, side, flat(field.corner_uvs)


@njit(**INLINE)
def columns_of(field):
    """How many numbers of a sample offset and colour see."""
    return field[3][1] + field[1][0][0][-1, OUT]


@njit(**INLINE)
def features_for(field, most):
    """Where `densities` puts encoded places, a row a feature."""
    return np.zeros((field[1][0][0][0, 0] + 1, most + ROOM), np.float32)


@njit(**INLINE)
def _untrained(distance, settings):
    """`field.Field.untrained`."""
    near = distance / settings[2] - settings[3]
    near = np.float32(1) - min(max(near, np.float32(0)), np.float32(1))
    return settings[0] + near * settings[1]


@njit(**INLINE)
def _encode(encoding, places, axes, start, count, features, row, scratch):
    """Features of places in the unit box, rows `axes` and on, from sample `start` on; one row each
    from `row` on."""
    table, levels = encoding
    unit, index, weight = scratch
    step = features.shape[1]
    flat_features = features.ravel()
    for k in range(len(levels)):
        res, entry, mask, level = levels[k]
        for begin in range(0, count, corners.BLOCK):
            n = min(corners.BLOCK, count - begin)
            for axis in range(3):
                source = places[axes + axis, start + begin : start + begin + n]
                for i in range(n):
                    unit[axis * corners.BLOCK + i] = source[i]
            corners.locate_block(unit, n, res, entry, mask, table, index, weight)
            at = (row + 2 * level) * step + begin
            for i in range(n):
                corners.read_corners(table, index, weight, i, flat_features, at + i, at + step + i)


@njit(**INLINE)
def _embed(surface, mesh_corners, triangle, places, begin, count, index, weight, out, step):
    """The appearance's features at samples from `begin` on, one row of out each."""
    latent, width, side, uvs = surface
    if width == 0:
        return
    if side == 0:
        for i in range(count):
            for k in range(3):
                index[k * rows.STRIDE + i] = mesh_corners[triangle[begin + i] * 3 + k]
                weight[k * rows.STRIDE + i] = places[WEIGHTS + k, begin + i]
        for i in range(count):
            rows.mix3(latent, width, index, weight, i, out, (begin + i) * step)
        return
    right = min(1, side - 1)
    for i in range(count):
        u = v = np.float32(0)
        for k in range(3):
            at = (triangle[begin + i] * 3 + k) * 2
            u += places[WEIGHTS + k, begin + i] * uvs[at]
            v += places[WEIGHTS + k, begin + i] * uvs[at + 1]
        x, fx = rows.texel(u, side)
        y, fy = rows.texel(v, side)
        for k in range(4):
            index[k * rows.STRIDE + i] = (y + right * (k >> 1)) * side + x + right * (k & 1)
            across = fx if k & 1 else np.float32(1) - fx
            weight[k * rows.STRIDE + i] = across * (fy if k >> 1 else np.float32(1) - fy)
    for i in range(count):
        rows.mix4(latent, width, index, weight, i, out, (begin + i) * step)


@njit(**INLINE)
def densities(start, stop, field, mesh_corners, samples, features, inputs, sigma):
    """What the networks see of samples start..stop, and their densities (1/m)."""
    encodings, networks, _, latent, untrained = field
    triangle, places = samples
    corner_scratch = (
        np.zeros(3 * corners.BLOCK, np.float32),
        np.zeros(8 * corners.STRIDE, np.int32),
        np.zeros(8 * corners.STRIDE, np.float32),
    )
    index, weight = np.zeros(4 * rows.STRIDE, np.int64), np.zeros(4 * rows.STRIDE, np.float32)
    density_work, offset_work = workspace(networks[0][0]), workspace(networks[1][0])
    (plan, packed), (offset_plan, offset), has_offset = networks
    room = features.shape[1]
    embedding, geometry = latent[1], plan[-1, OUT]
    columns = embedding + geometry
    no_rows, no_group = np.zeros((0, 0), np.float32), np.zeros(0, np.int32)
    zero, one = np.int64(0), np.int64(1)
    _encode(encodings[0], places, 0, start, stop - start, features, 0, corner_scratch)
    rest = 2 * len(encodings[0][1])
    _encode(encodings[1], places, RESTING, start, stop - start, features, rest, corner_scratch)
    seen = features.ravel()
    for begin in range(start, stop, BLOCK):
        n = min(BLOCK, stop - begin)
        through_layers(zero, n, n, len(plan), seen, begin - start, one, room, packed, plan, no_rows,
                       no_group, density_work)  # fmt: skip
        _embed(latent, mesh_corners, triangle, places, begin, n, index, weight, inputs,
               columns)  # fmt: skip
        at, wide = plan[-1, HIDDEN], plan[-1, OUT_PAD]
        for i in range(n):
            to = (begin + i) * columns + embedding
            for k in range(geometry):
                inputs[to + k] = density_work[at + i * wide + k]
        if has_offset:
            through_layers(zero, n, n, len(offset_plan), inputs, begin * columns, columns, one,
                           offset, offset_plan, no_rows, no_group, offset_work)  # fmt: skip
            at, wide = offset_plan[-1, HIDDEN], offset_plan[-1, OUT_PAD]
            for i in range(n):
                inputs[(begin + i) * columns + embedding] += offset_work[at + i * wide]
        for i in range(begin, begin + n):
            raw = inputs[i * columns + embedding] + _untrained(places[DISTANCE, i], untrained)
            sigma[i] = np.exp(min(raw, untrained[4])) * np.float32(1e3)


@njit(**INLINE)
def shade(count, base, views, field, inputs, shown, shown_row, shown_weight, lit, work, out):
    """Add to rows `base` + shown_row of out the colours of `count` samples by their weights, and
    the weights; views [rays, hidden]: what each ray's direction adds to the first layer."""
    plan, packed = field[2]
    columns = columns_of(field)
    zero, one = np.int64(0), np.int64(1)
    group = views[base:]
    for begin in range(0, count, BLOCK):
        n = min(BLOCK, count - begin)
        for i in range(n):
            source = shown[begin + i] * columns
            for k in range(columns):
                lit[i * columns + k] = inputs[source + k]
        through_layers(begin, n, n, len(plan), lit, zero, columns, one, packed, plan, group,
                       shown_row, work)  # fmt: skip
        at, wide = plan[-1, HIDDEN], plan[-1, OUT_PAD]
        for i in range(n):
            ray = base + shown_row[begin + i]
            seen = shown_weight[begin + i]
            for k in range(3):
                out[ray, k] += seen / (np.float32(1) + np.exp(-work[at + i * wide + k]))
            out[ray, 3] += seen
