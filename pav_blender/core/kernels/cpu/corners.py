"""The innermost steps of the hash encoding, as LLVM vectors for use inside compiled kernels.

A level of the encoding first works out the table entries and weights of the 8 corners round every
sample of a block (the same arithmetic for a register full of samples), then reads or adds entries
one sample after another, both features at once, while entries of samples further on are fetched:
the tables do not fit the second cache, and without that two thirds of the time is waiting.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from ..reference.encoding import PRIMES
from .search import LEAN
from .tiles import LANES
from .writer import FLOAT, INT, LONG, Writer

BLOCK = 512  # samples whose corners are worked out together
AHEAD = 32  # samples between fetching an entry and reading it; 8 is too late, 128 too early
STRIDE = BLOCK + AHEAD  # from corner to corner; what is fetched past the end is never read

_FLOATS = ir.VectorType(FLOAT, LANES)
_INTS = ir.VectorType(INT, LANES)
_PAIR = ir.VectorType(FLOAT, 2)


def _entry(writer: Writer, table: Any, index: Any, i: Any, corner: int) -> Any:
    """Place in the table of what a corner of sample i has: two float32 or, where the table is of
    int32, two bfloat16."""
    builder = writer.builder
    at = builder.add(i, LONG(corner * STRIDE))
    entry = builder.zext(writer.load(index, at, INT), LONG)
    return entry if table.type.pointee == INT else builder.shl(entry, LONG(1))


def _features(writer: Writer, table: Any, entry: Any, entries: int) -> Any:
    """The features of entries that lie side by side, in float32."""
    builder, kind = writer.builder, ir.VectorType(FLOAT, 2 * entries)
    if table.type.pointee != INT:
        return writer.load(table, entry, kind)
    whole, short = (ir.VectorType(ir.IntType(bits), 2 * entries) for bits in (32, 16))
    bits = builder.zext(writer.load(table, entry, short), whole)
    return builder.bitcast(builder.shl(bits, ir.Constant(whole, [16] * 2 * entries)), kind)


def _fetch(writer: Writer, table: Any, index: Any, i: Any) -> None:
    """Ask for the entries of the sample AHEAD of i, from every corner with the lower x: its
    neighbour in x mostly shares the cache line."""
    later = writer.builder.add(i, LONG(AHEAD))
    for corner in (0, 2, 4, 6):
        writer.fetch(table, _entry(writer, table, index, later, corner))


def _cells(writer: Writer, points: Any, at: Any, cells: Any) -> tuple[list[Any], ...]:
    """Of samples at, at + 1, ..., along each axis: the cell, and the weights of its two ends."""
    builder = writer.builder
    scale = writer.splat(builder.sitofp(cells, FLOAT), _FLOATS)
    last = writer.splat(builder.sub(cells, INT(1)), _INTS)
    one = ir.Constant(_FLOATS, [1.0] * LANES)
    cell, near, far = [], [], []
    for axis in range(3):
        here = builder.add(at, LONG(axis * BLOCK))
        position = builder.fmul(writer.load(points, here, _FLOATS), scale)
        whole = builder.fptosi(position, _INTS)
        whole = builder.select(builder.icmp_signed("<", whole, last), whole, last)
        fraction = builder.fsub(position, builder.sitofp(whole, _FLOATS))
        cell.append(whole)
        far.append(fraction)
        near.append(builder.fsub(one, fraction))
    return cell, near, far


def _locator(hashed: bool) -> Any:
    @intrinsic
    def locate(typing, unit, i, res, first, mask, index, weight):
        """Entries (counted from the whole table's start) and weights of samples i, i + 1, ..."""

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            writer = Writer(context, builder, signature, values)
            points, at, cells, start, bits, indices, weights = writer.values
            cells, start, bits = (builder.trunc(v, INT) for v in (cells, start, bits))
            cell, near, far = _cells(writer, points, at, cells)
            entries = (_hashed if hashed else _dense)(writer, cell, cells, bits)
            begin = writer.splat(start, _INTS)
            for corner in range(8):
                x, y, z = ((far if corner >> axis & 1 else near)[axis] for axis in range(3))
                here = builder.add(at, LONG(corner * STRIDE))
                writer.store(writer.product(writer.product(y, z), x), weights, here)
                writer.store(builder.add(entries[corner], begin), indices, here)
            return context.get_dummy_value()

        return types.void(unit, i, res, first, mask, index, weight), generate

    return locate


def _dense(writer: Writer, cell: list[Any], cells: Any, bits: Any) -> list[Any]:
    builder = writer.builder
    row = builder.add(cells, INT(1))
    layer = builder.mul(row, row)
    entry = builder.add(cell[0], builder.mul(cell[1], writer.splat(row, _INTS)))
    entry = builder.add(entry, builder.mul(cell[2], writer.splat(layer, _INTS)))
    entries = []
    for corner in range(8):
        step = INT(corner & 1)
        step = builder.add(step, row) if corner & 2 else step
        step = builder.add(step, layer) if corner & 4 else step
        entries.append(builder.add(entry, writer.splat(step, _INTS)))
    return entries


def _hashed(writer: Writer, cell: list[Any], cells: Any, bits: Any) -> list[Any]:
    builder = writer.builder
    primes = [ir.Constant(_INTS, [prime] * LANES) for prime in PRIMES]
    near = [builder.mul(part, prime) for part, prime in zip(cell, primes, strict=True)]
    far = [builder.add(part, prime) for part, prime in zip(near, primes, strict=True)]
    mask = writer.splat(bits, _INTS)
    entries = []
    for corner in range(8):
        x, y, z = ((far if corner >> axis & 1 else near)[axis] for axis in range(3))
        entries.append(builder.and_(builder.xor(x, builder.xor(y, z)), mask))
    return entries


_locate_dense = _locator(False)
_locate_hashed = _locator(True)


def _both(writer: Writer, entries: Any, indices: Any, weights: Any, at: Any) -> Any:
    """The two features of a sample."""
    sums = [ir.Constant(_PAIR, None)] * 2
    for corner in range(8):
        here = writer.builder.add(at, LONG(corner * STRIDE))
        share = writer.splat(writer.load(weights, here, FLOAT), _PAIR)
        pair = _features(writer, entries, _entry(writer, entries, indices, at, corner), 1)
        half = corner & 1
        sums[half] = writer.total(sums[half], writer.product(share, pair))
    _fetch(writer, entries, indices, at)
    return writer.builder.fadd(*sums)


def _put(writer: Writer, both: Any, kind: Any, target: Any, places: Any) -> None:
    """Write two features: into int16 side by side, rounded to bfloat16, else each in its place."""
    if kind.dtype == types.int16:
        writer.store_short(both, target, places[0])
        return
    for feature, place in enumerate(places):
        writer.store(writer.builder.extract_element(both, INT(feature)), target, place)


@intrinsic
def read_corners(typing, table, index, weight, i, out, first, second):
    """Write the two features of sample i to out, at `first` and at `second`; an int16 array gets
    them in bfloat16, both from `first` on."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        writer = Writer(context, builder, signature, values)
        entries, indices, weights, at, target, *places = writer.values
        both = _both(writer, entries, indices, weights, at)
        _put(writer, both, signature.args[4], target, places)
        return context.get_dummy_value()

    return types.void(table, index, weight, i, out, first, second), generate


@intrinsic
def _locate_edges(typing, unit, i, res, first, index, weight):
    """As `_locate_dense`, of the four edges along x round samples i, i + 1, ...: the entry of the
    lower end, the weight of each, and after these how far along it the samples lie."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        writer = Writer(context, builder, signature, values)
        points, at, cells, start, indices, weights = writer.values
        cells, start = (builder.trunc(v, INT) for v in (cells, start))
        cell, near, far = _cells(writer, points, at, cells)
        entries = _dense(writer, cell, cells, None)
        begin = writer.splat(start, _INTS)
        for edge in range(4):
            y, z = ((far if edge >> bit & 1 else near)[bit + 1] for bit in range(2))
            here = builder.add(at, LONG(edge * STRIDE))
            writer.store(writer.product(y, z), weights, here)
            writer.store(builder.add(entries[2 * edge], begin), indices, here)
        writer.store(far[0], weights, builder.add(at, LONG(4 * STRIDE)))
        return context.get_dummy_value()

    return types.void(unit, i, res, first, index, weight), generate


@intrinsic
def read_edges(typing, table, index, weight, i, out, first, second):
    """As `read_corners`, on a dense level that `locate_edges` looked at: both ends of an edge lie
    side by side."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        writer = Writer(context, builder, signature, values)
        entries, indices, weights, at, target, *places = writer.values
        ends = ir.VectorType(FLOAT, 4)
        total = ir.Constant(ends, None)
        for edge in range(4):
            here = builder.add(at, LONG(edge * STRIDE))
            share = writer.splat(writer.load(weights, here, FLOAT), ends)
            both = _features(writer, entries, _entry(writer, entries, indices, at, edge), 2)
            total = writer.total(total, writer.product(share, both))
        low, high = (
            builder.shuffle_vector(total, total, ir.Constant(ir.VectorType(INT, 2), [end, end + 1]))
            for end in (0, 2)
        )
        along = writer.load(weights, builder.add(at, LONG(4 * STRIDE)), FLOAT)
        step = writer.product(writer.splat(along, _PAIR), builder.fsub(high, low))
        _put(writer, writer.total(low, step), signature.args[4], target, places)
        return context.get_dummy_value()

    return types.void(table, index, weight, i, out, first, second), generate


@intrinsic
def add_corners(typing, table, index, weight, i, source, first, second):
    """Add the gradient of sample i's two features, at `first` and `second`, to its entries."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        writer = Writer(context, builder, signature, values)
        entries, indices, weights, at, grads, *places = writer.values
        slope = ir.Constant(_PAIR, ir.Undefined)
        for feature, place in enumerate(places):
            value = writer.load(grads, place, FLOAT)
            slope = builder.insert_element(slope, value, INT(feature))
        _fetch(writer, entries, indices, at)
        for corner in range(8):
            here = builder.add(at, LONG(corner * STRIDE))
            share = writer.splat(writer.load(weights, here, FLOAT), _PAIR)
            place = _entry(writer, entries, indices, at, corner)
            pair = writer.load(entries, place, _PAIR)
            writer.store(writer.total(pair, writer.product(share, slope)), entries, place)
        return context.get_dummy_value()

    return types.void(table, index, weight, i, source, first, second), generate


@intrinsic
def _fetch_corners(typing, table, index, i):
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        writer = Writer(context, builder, signature, values)
        _fetch(writer, *writer.values)
        return context.get_dummy_value()

    return types.void(table, index, i), generate


@njit(**LEAN)
def locate_block(unit, count, res, first, mask, table, index, weight):
    """Corners of the `count` points in unit [3 * BLOCK] on one level, and the first ones fetched.

    index and weight [8 * STRIDE] receive them; mask is 0 on a dense level; first is the level's
    first entry in the table.
    """
    if mask == 0:
        for i in range(0, count, LANES):
            _locate_dense(unit, i, res, first, mask, index, weight)
    else:
        for i in range(0, count, LANES):
            _locate_hashed(unit, i, res, first, mask, index, weight)
    for i in range(-AHEAD, 0):
        _fetch_corners(table, index, i)


@njit(**LEAN)
def locate_edges(unit, count, res, first, index, weight):
    """Edges along x round the `count` points in unit [3 * BLOCK] on a dense level, for
    `read_edges`; index [4 * STRIDE] and weight [5 * STRIDE] receive them."""
    for i in range(0, count, LANES):
        _locate_edges(unit, i, res, first, index, weight)
