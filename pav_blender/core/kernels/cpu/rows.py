"""Weighted sums of a few rows of a table, and the gradient of that, inside compiled kernels.

Reading a texture between four texels and a mesh between three vertices is the same thing. As in
`corners`, rows and weights are worked out for a block of samples, and rows of samples further on
are fetched while one is read.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from .tiles import LANES
from .writer import FLOAT, LONG, Writer

BLOCK = 256
AHEAD = 16
STRIDE = BLOCK + AHEAD  # what is fetched past the end is never read
_STRIPE = 6  # rows that follow one another go to one thread, 2^6 at a time
_FLOATS = ir.VectorType(FLOAT, LANES)


def _fetch(writer: Writer, table: Any, index: Any, i: Any, count: int, width: Any) -> None:
    builder = writer.builder
    for k in range(count):
        at = builder.add(i, LONG(k * STRIDE + AHEAD))
        writer.fetch(table, builder.mul(writer.load(index, at, LONG), width))


def _channels(writer: Writer, width: Any, visit: Any) -> None:
    """Call visit(first channel, type) for vectors of channels, then for what is left over."""
    builder = writer.builder
    whole = builder.and_(width, LONG(-LANES))
    steps = builder.udiv(whole, LONG(LANES))
    with cgutils.for_range(builder, steps, intp=LONG) as loop:
        visit(builder.mul(loop.index, LONG(LANES)), _FLOATS)
    with cgutils.for_range(builder, builder.sub(width, whole), intp=LONG) as loop:
        visit(builder.add(whole, loop.index), FLOAT)


def _mixer(count: int) -> Any:
    @intrinsic
    def mix(typing, table, width, index, weight, i, out, first):
        """out[first:first + width] = the weighted sum of sample i's `count` rows of table, in
        bfloat16 where out is int16."""
        brief = out.dtype == types.int16

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            writer = Writer(context, builder, signature, values)
            source, columns, indices, weights, at, target, place = writer.values
            _fetch(writer, source, indices, at, count, columns)
            rows, shares = [], []
            for k in range(count):
                here = builder.add(at, LONG(k * STRIDE))
                rows.append(builder.mul(writer.load(indices, here, LONG), columns))
                shares.append(writer.load(weights, here, FLOAT))

            def visit(channel: Any, kind: Any) -> None:
                total = ir.Constant(kind, None)
                for row, share in zip(rows, shares, strict=True):
                    value = writer.load(source, builder.add(row, channel), kind)
                    total = writer.total(total, writer.product(writer.splat(share, kind), value))
                at = builder.add(place, channel)
                if brief:
                    writer.store_short(writer.as_vector(total), target, at)
                else:
                    writer.store(total, target, at)

            _channels(writer, columns, visit)
            return context.get_dummy_value()

        return types.void(table, width, index, weight, i, out, first), generate

    return mix


@intrinsic
def _spread(typing, table, width, row, share, source, first):
    """table[row] += share * source[first:first + width]"""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        writer = Writer(context, builder, signature, values)
        target, columns, line, part, grads, place = writer.values
        begin = builder.mul(line, columns)

        def visit(channel: Any, kind: Any) -> None:
            at = builder.add(begin, channel)
            slope = writer.load(grads, builder.add(place, channel), kind)
            added = writer.product(writer.splat(part, kind), slope)
            writer.store(writer.total(writer.load(target, at, kind), added), target, at)

        _channels(writer, columns, visit)
        return context.get_dummy_value()

    return types.void(table, width, row, share, source, first), generate


mix3 = _mixer(3)
mix4 = _mixer(4)


@njit(cache=True, nogil=True)
def read_rows(table, width, index, weight, corners, count, out, begin):
    """Rows of out from `begin` on: what `count` samples read from table; corners is 3 or 4."""
    if corners == 4:
        for i in range(count):
            mix4(table, width, index, weight, i, out, (begin + i) * width)
    else:
        for i in range(count):
            mix3(table, width, index, weight, i, out, (begin + i) * width)


@njit(cache=True, nogil=True)
def add_rows(table, width, index, weight, corners, count, grad_out, begin, part, parts):
    """Add the gradients of `count` samples to those rows of table that are part's of parts.

    parts is a power of two. Every row belongs to one part and is added to in the order of
    samples: no two threads meet, and sums do not depend on how many there are.
    """
    for i in range(count):
        for k in range(corners):
            row = index[k * STRIDE + i]
            if (row >> _STRIPE) & (parts - 1) == part:
                share = weight[k * STRIDE + i]
                _spread(table, width, row, share, grad_out, (begin + i) * width)


@njit(cache=True, nogil=True)
def texel(coordinate, size):
    """Texel below a coordinate in [0, 1] and how far the coordinate lies toward the next."""
    c = coordinate if coordinate > 0 else np.float32(0)
    c = c if c < 1 else np.float32(1)
    position = c * np.float32(size) - np.float32(0.5)
    position = min(max(position, np.float32(0)), np.float32(size - 1))
    low = min(np.int64(position), max(size - 2, 0))
    return low, position - np.float32(low)


@njit(cache=True, nogil=True)
def locate_texels(size, appearance, uv, begin, count, index, weight):
    """The four texels round every sample from `begin` on, and their weights."""
    right = min(1, size - 1)
    for i in range(count):
        u, fu = texel(uv[begin + i, 0], size)
        v, fv = texel(uv[begin + i, 1], size)
        row = (appearance[begin + i] * size + v) * size + u
        gu = np.float32(1) - fu
        gv = np.float32(1) - fv
        index[i] = row
        index[STRIDE + i] = row + right
        index[2 * STRIDE + i] = row + right * size
        index[3 * STRIDE + i] = row + right * size + right
        weight[i] = gu * gv
        weight[STRIDE + i] = fu * gv
        weight[2 * STRIDE + i] = gu * fv
        weight[3 * STRIDE + i] = fu * fv


@njit(cache=True, nogil=True)
def locate_vertices(
    vertices, appearance, triangles, triangle, barycentric, begin, count, index, weight
):
    """The three vertices of every sample's triangle from `begin` on, and their weights."""
    for i in range(count):
        first = np.int64(appearance[begin + i]) * vertices
        for k in range(3):
            index[k * STRIDE + i] = first + triangles[triangle[begin + i], k]
            weight[k * STRIDE + i] = barycentric[begin + i, k]
