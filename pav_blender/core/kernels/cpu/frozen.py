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
from .exponential import exp
from .lanes import LANES, load, splat, store
from .marching import flat, rows_of
from .mlp import BLOCK, HIDDEN, OUT, OUT_PAD, pack, through_layers, workspace
from .search import INLINE, LEAN

# rows of a sample's places: canonical in the unit box, resting with the shoulders, barycentrics,
# distance from the mesh
RESTING, WEIGHTS, DISTANCE, PLACES = 3, 6, 9, 10
ROOM = corners.BLOCK  # samples past the last that a block may touch


def arrays_of(field: Frozen) -> tuple[Any, ...]:
    """What compiled functions are told of a field: encodings, density and offset, colour, latent,
    the numbers of an untrained density, and how appearances mix."""
    return (
        encodings_of(field),
        (_packed(field.density), _packed(field.offset), field.offset is not None),
        _packed(field.colour),
        latent_of(field),
        untrained_of(field),
        mixing_of(field),
    )


def untrained_of(field: Frozen) -> np.ndarray:
    return np.array([*field.untrained, field.limit], np.float32)


def mixing_of(field: Frozen) -> tuple[Any, ...]:
    """How appearances mix: their number, shares and filled cells, each with the cells a side, and
    the numbers of `field.mixture`."""
    return (
        len(field.shares),
        rows_of(field.shares.reshape(-1), np.float32),
        field.shares.shape[1],
        rows_of(field.filled.reshape(-1), np.bool_),
        field.filled.shape[1],
        np.array(field.mixing, np.float32),
    )


def encodings_of(field: Frozen) -> tuple[Any, Any]:
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


def latent_of(field: Frozen) -> tuple[Any, ...]:
    """The latent features in a row, their number, texels a side (0: at vertices), corners' UVs."""
    width = field.latent.shape[-1]
    side = field.latent.shape[1] if len(field.corner_uvs) else 0
    features = rows_of(field.latent.reshape(-1), np.float32)
    return features, width, side, flat(field.corner_uvs)


@njit(**INLINE)
def columns_of(field):
    """How many numbers of a sample offset and colour see."""
    return field[3][1] + field[1][0][0][-1, OUT]


@njit(**INLINE)
def features_for(field, most):
    """Where `densities` puts encoded places, a row a feature."""
    return np.zeros((field[1][0][0][0, 0] + 1, most + ROOM), np.float32)


@njit(**INLINE)
def inputs_for(field, count):
    """Where `densities` puts what offset and colour see of `count` samples, a row each."""
    return np.zeros(count * columns_of(field), np.float32)


@njit(**INLINE)
def shading_room(field):
    """What `shade` needs to work in."""
    return np.zeros((BLOCK + ROOM) * columns_of(field), np.float32), workspace(field[2][0])


@njit(**LEAN)
def untrained(distance, settings):
    """`field.Field.untrained`."""
    near = distance / settings[2] - settings[3]
    near = np.float32(1) - min(max(near, np.float32(0)), np.float32(1))
    return settings[0] + near * settings[1]


@njit(**LEAN)
def encode(encoding, places, axes, start, count, features, at, steps, scratch):
    """Features of places in the unit box, rows `axes` and on, from sample `start` on.

    They go to `features` from `at` on; steps: from level to level, from sample to sample, and from
    the first feature to the second.
    """
    table, levels = encoding
    unit, index, weight = scratch
    to_level, to_sample, to_second = steps
    for k in range(len(levels)):
        res, entry, mask, level = levels[k]
        for begin in range(0, count, corners.BLOCK):
            n = min(corners.BLOCK, count - begin)
            for axis in range(3):
                source = places[axes + axis, start + begin : start + begin + n]
                for i in range(n):
                    unit[axis * corners.BLOCK + i] = source[i]
            first = at + level * to_level + begin * to_sample
            if mask == 0:
                corners.locate_edges(unit, n, res, entry, index, weight)
                for i in range(n):
                    here = first + i * to_sample
                    corners.read_edges(table, index, weight, i, features, here, here + to_second)
            else:
                corners.locate_block(unit, n, res, entry, mask, table, index, weight)
                for i in range(n):
                    here = first + i * to_sample
                    corners.read_corners(table, index, weight, i, features, here, here + to_second)


@njit(**LEAN)
def embedding_rows(surface, first, mesh_corners, triangle, places, begin, count, index, weight,
                   out, row, step):  # fmt: skip
    """An appearance's features, which are from `first` on, at samples from `begin` on, one row of
    out each from `row` on."""
    latent, width, side, uvs = surface
    if width == 0:
        return
    if side == 0:
        for i in range(count):
            for k in range(3):
                index[k * rows.STRIDE + i] = first + mesh_corners[triangle[begin + i] * 3 + k]
                weight[k * rows.STRIDE + i] = places[WEIGHTS + k, begin + i]
        for i in range(count):
            rows.mix3(latent, width, index, weight, i, out, (row + i) * step)
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
            texel = (y + right * (k >> 1)) * side + x + right * (k & 1)
            index[k * rows.STRIDE + i] = first + texel
            across = fx if k & 1 else np.float32(1) - fx
            weight[k * rows.STRIDE + i] = across * (fy if k >> 1 else np.float32(1) - fy)
    for i in range(count):
        rows.mix4(latent, width, index, weight, i, out, (row + i) * step)


@njit(**LEAN)
def _share(shares, size, first, x, y, z):
    """A grid's value at a place of the unit box; values are those of the cells' middles."""
    total = np.float32(0)
    side, half = np.float32(size), np.float32(0.5)
    px, py, pz = x * side - half, y * side - half, z * side - half
    ix, iy, iz = np.int64(np.floor(px)), np.int64(np.floor(py)), np.int64(np.floor(pz))
    fx, fy, fz = px - np.float32(ix), py - np.float32(iy), pz - np.float32(iz)
    for corner in range(8):
        a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
        weight = fx if a else np.float32(1) - fx
        weight *= fy if b else np.float32(1) - fy
        weight *= fz if c else np.float32(1) - fz
        at = min(max(ix + a, 0), size - 1) * size + min(max(iy + b, 0), size - 1)
        total += weight * shares[first + at * size + min(max(iz + c, 0), size - 1)]
    return total


@njit(**LEAN)
def mix(begin, end, mixing, places, parts, sigma):
    """`field.mixture.mix`: parts hold each appearance's density (1/m), and then its part in the
    colour."""
    count, shares, size, filled, cells, numbers = mixing
    empty, thick = numbers[0], numbers[3]
    widest = np.log(numbers[1] / empty)
    room = len(sigma)
    for i in range(begin, end):
        x, y, z = places[0, i], places[1, i], places[2, i]
        cell = min(np.int64(x * np.float32(cells)), cells - 1) * cells
        cell = (cell + min(np.int64(y * np.float32(cells)), cells - 1)) * cells
        cell += min(np.int64(z * np.float32(cells)), cells - 1)
        fading = beyond = total = np.float32(0)
        for k in range(count):
            density = np.float32(0)
            if filled[k * cells**3 + cell]:
                density = parts[k * room + i] * np.float32(1e-3)
            share = _share(shares, size, k * size**3, x, y, z)
            above = np.log(max(density / empty, np.float32(1)))
            fading += share * min(above, widest)
            beyond += share * max(above - widest, np.float32(0))
            part = share * (np.float32(1) - np.exp(-density * thick))
            parts[k * room + i] = part
            total += part
        solid = (fading / widest) ** numbers[2]
        sigma[i] = empty * (np.exp(fading + solid * beyond) - np.float32(1)) * np.float32(1e3)
        for k in range(count):
            parts[k * room + i] /= max(total, np.float32(1e-12))


@njit(**INLINE)
def densities(start, stop, field, mesh_corners, samples, features, inputs, sigma, parts):
    """What the networks see of samples start..stop, their densities (1/m), and each appearance's
    part in the colour where there are several: appearance k has row k * len(sigma) + sample."""
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
    density_work, offset_work = workspace(networks[0][0]), workspace(networks[1][0])
    (plan, packed), (offset_plan, offset), has_offset = networks
    embedding, geometry = latent[1], plan[-1, OUT]
    columns = embedding + geometry
    no_rows, no_group = np.zeros((0, 0), np.float32), np.zeros(0, np.int32)
    logs = np.zeros(BLOCK + LANES, np.float32)
    zero, one = np.int64(0), np.int64(1)
    seen, step = features.ravel(), features.shape[1]
    steps, rest = (2 * step, one, step), 2 * step * len(encodings[0][1])
    encode(encodings[0], places, 0, start, stop - start, seen, zero, steps, corner_scratch)
    encode(encodings[1], places, RESTING, start, stop - start, seen, rest, steps, corner_scratch)
    for begin in range(start, stop, BLOCK):
        n = min(BLOCK, stop - begin)
        through_layers(zero, n, n, len(plan), seen, begin - start, one, features.shape[1], packed,
                       plan, no_rows, no_group, density_work)  # fmt: skip
        for k in range(count):
            row = k * room + begin
            embedding_rows(latent, k * of_one, mesh_corners, triangle, places, begin, n, index,
                           weight, inputs, row, columns)  # fmt: skip
            at, wide = plan[-1, HIDDEN], plan[-1, OUT_PAD]
            for i in range(n):
                to = (row + i) * columns + embedding
                for channel in range(geometry):
                    inputs[to + channel] = density_work[at + i * wide + channel]
            if has_offset:
                through_layers(zero, n, n, len(offset_plan), inputs, row * columns, columns, one,
                               offset, offset_plan, no_rows, no_group, offset_work)  # fmt: skip
                at, wide = offset_plan[-1, HIDDEN], offset_plan[-1, OUT_PAD]
                for i in range(n):
                    inputs[(row + i) * columns + embedding] += offset_work[at + i * wide]
            for i in range(n):
                raw = inputs[(row + i) * columns + embedding]
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
    """Add to rows `base` + shown_row of out the colours of `count` samples by their weights, and
    the weights; views [rays, hidden]: what each ray's direction adds to the first layer."""
    plan, packed = field[2]
    lit, work = room
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
        at = plan[-1, HIDDEN]
        add_colours(work[at:], plan[-1, OUT_PAD], n, begin, base, shown_row, shown_weight, out)


@njit(**LEAN)
def add_colours(found, wide, count, begin, base, shown_row, shown_weight, out):
    """Add to their rays what `count` samples show, from `begin` on: of each the network's answer
    before it is a colour, in a row of `found` as wide as a vector at least."""
    one = splat(1.0)
    for i in range(count):
        value = load(found, i * wide)
        store(found, i * wide, one / (one + exp(splat(0.0) - value)))
        ray = base + shown_row[begin + i]
        seen = shown_weight[begin + i]
        for k in range(3):
            out[ray, k] += seen * found[i * wide + k]
        out[ray, 3] += seen


@njit(**LEAN)
def to_densities(logs, count, out, begin):
    """Densities (1/m) of `count` log-densities a millimetre, to out from `begin` on; up to a vector
    of what follows is overwritten."""
    for i in range(0, count, LANES):
        store(out, begin + i, exp(load(logs, i)) * splat(1e3))
