"""Networks in bfloat16 with float32 sums, for fields that are only read.

A processor that multiplies pairs of bfloat16 numbers (AVX-512 BF16) does so at twice the rate of
float32 and reads half the bytes. Two numbers that follow one another along the depth of a product
lie in one int32, the first in its lower half; an array of rows of such numbers is int16. Rounding
is to the nearest.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from llvmlite import binding, ir
from numba import njit, types
from numba.extending import intrinsic

from ..structures import Layers
from .lanes import load, store
from .mlp import BLOCK
from .search import INLINE, LEAN
from .tiles import LANES, ROWS, SHAPES, Tile
from .writer import FLOAT, INT, Writer

IN, OUT, OUT_PAD, WEIGHT, BIAS, HIDDEN = range(6)  # columns of a plan, one row a layer
_LARGEST = 1e37  # beyond it, rounding or sums might not be finite


class _Brief(ir.Type):
    """LLVM's bfloat, which llvmlite has no name for."""

    def _to_string(self) -> str:
        return "bfloat"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Brief)

    def __hash__(self) -> int:
        return hash(_Brief)


_PAIRS = ir.VectorType(_Brief(), 2 * LANES)
_INTS = ir.VectorType(INT, LANES)


def available() -> bool:
    """Whether this processor multiplies pairs of bfloat16 numbers."""
    return LANES == 16 and bool(dict(binding.get_host_cpu_features()).get("avx512bf16"))


class Network(NamedTuple):
    """A network as compiled functions take it: plan [layers, 6], weights in pairs, biases."""

    plan: np.ndarray
    weights: np.ndarray
    biases: np.ndarray


def fit(layers: Layers | None) -> bool:
    """Whether all numbers of a network can be written in bfloat16 and summed."""
    return layers is None or all(small(x) for x in (*layers.weights, *layers.biases))


def small(values: torch.Tensor) -> bool:
    """Whether numbers are far from the largest that there are."""
    return values.numel() == 0 or float(values.abs().max()) < _LARGEST


def rounded(values: np.ndarray) -> np.ndarray:
    """float32 numbers as bfloat16, in int16."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32) + np.uint32(0x8000)
    return (bits >> 16).astype(np.uint16).view(np.int16)


def pack(layers: Layers | None, order: np.ndarray | None = None) -> Network:
    """A network's weights in pairs; order: which place of the inputs each column goes to, for
    inputs with gaps between them."""
    if layers is None:
        return Network(np.zeros((1, 6), np.int64), np.zeros(1, np.int32), np.zeros(1, np.float32))
    plan, weights, biases = [], [], []
    ins = len(layers.weights[0][0]) if order is None else int(order.max(initial=-1)) + 1
    at = first = hidden = 0
    for weight, bias in zip(layers.weights, layers.biases, strict=True):
        outs = len(bias)
        pairs, pad = -(-ins // 2), -(-outs // LANES) * LANES
        columns = np.arange(weight.shape[1]) if order is None else order
        padded = np.zeros((2 * pairs, pad), np.float32)
        padded[columns, :outs] = weight.detach().numpy().T
        halves = rounded(padded).reshape(pairs, 2, pad).transpose(0, 2, 1)
        weights.append(np.ascontiguousarray(halves).reshape(-1).view(np.int32))
        biases.append(np.zeros(pad, np.float32))
        biases[-1][:outs] = bias.detach().numpy()
        plan.append((pairs, outs, pad, at, first, hidden))
        at, first, hidden = at + pairs * pad, first + pad, hidden + BLOCK * pad
        ins, order = outs, None
    return Network(np.array(plan, np.int64), np.concatenate(weights), np.concatenate(biases))


@intrinsic
def shorten(typing, value, out, at):
    """out[at] = a float32 number, rounded."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        writer = Writer(context, builder, signature, values)
        number, target, place = writer.values
        writer.store_short(writer.as_vector(number), target, place)
        return context.get_dummy_value()

    return types.void(types.float32, out, types.int64), generate


@intrinsic
def shorten_row(typing, source, begin, out, at):
    """out[at:at + LANES] = source[begin:begin + LANES], rounded."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        writer = Writer(context, builder, signature, values)
        numbers, first, target, place = writer.values
        value = writer.load(numbers, first, ir.VectorType(FLOAT, LANES))
        writer.store_short(value, target, place)
        return context.get_dummy_value()

    return types.void(source, types.int64, out, types.int64), generate


_ARGUMENTS = (
    *("depth", "out", "out_at", "out_step", "init", "init_at", "init_step"),
    *("a", "a_at", "a_step", "a_stride", "b", "b_at", "b_step"),
)


class _PairTile(Tile):
    """As `Tile`, for a and b of pairs; out may be int16: then what is below zero becomes zero."""

    def __init__(self, context: Any, builder: Any, signature: Any, values: Any) -> None:
        super().__init__(context, builder, signature, values, _ARGUMENTS)
        self.shortened = Writer(context, builder, signature, values).shortened
        self.brief = signature.args[1].dtype == types.int16
        kind = ir.FunctionType(self.vector, [self.vector, _PAIRS, _PAIRS])
        name, known = "llvm.x86.avx512bf16.dpbf16ps.512", builder.module.globals
        self.dot = known[name] if name in known else ir.Function(builder.module, kind, name)

    def load(self, name: str, row: int, column: int, along: Any = None) -> Any:
        pointer = self.address(name, row, column, along)
        kind = _INTS if name == "b" else self.vector
        return self.builder.load(self.builder.bitcast(pointer, kind.as_pointer()), align=4)

    def broadcast(self, value: Any) -> Any:
        undefined = ir.Constant(_INTS, ir.Undefined)
        one = self.builder.insert_element(undefined, value, INT(0))
        return self.builder.shuffle_vector(one, undefined, ir.Constant(_INTS, None))

    def add_product(self, total: Any, left: Any, right: Any) -> Any:
        pairs = (self.builder.bitcast(value, _PAIRS) for value in (left, right))
        return self.builder.call(self.dot, [total, *pairs])

    def store_all(self, results: list[Any], vectors: int) -> None:
        builder, zero = self.builder, ir.Constant(self.vector, None)
        for i, result in enumerate(results):
            value = result
            if self.brief:  # unordered: what is not a number stays so
                keep = builder.fcmp_unordered(">", result, zero)
                value = self.shortened(builder.select(keep, result, zero))
            pointer = self.address("out", *divmod(i, vectors))
            builder.store(value, builder.bitcast(pointer, value.type.as_pointer()), align=2)


def _tile(rows: int, vectors: int) -> Any:
    @intrinsic
    def tile(typing, depth, out, out_at, out_step, init, init_at, init_step, a, a_at, a_step,
             a_stride, b, b_at, b_step):  # fmt: skip
        kinds = (depth, out, out_at, out_step, init, init_at, init_step, a, a_at, a_step,
                 a_stride, b, b_at, b_step)  # fmt: skip

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            writer = _PairTile(context, builder, signature, values)
            writer.store_all(writer.accumulate(rows, vectors), vectors)
            return context.get_dummy_value()

        return types.void(*kinds), generate

    return tile


_wide, _double, _single = (_tile(*shape) for shape in SHAPES)
_WIDE_ROWS, _DOUBLE_ROWS, _SINGLE_ROWS = (rows for rows, _ in SHAPES)
_WIDE = SHAPES[0][1]


@njit(**LEAN)
def _multiply(rows, columns, depth, out, out_at, out_step, init, init_at, init_step, a, a_at,
              a_step, a_stride, b, b_at, b_step):  # fmt: skip
    """As `tiles.multiply`, depth in pairs."""
    width = columns
    column = 0
    while width > 0:
        if width > (_WIDE - 1) * LANES:
            for row in range(0, rows, _WIDE_ROWS):
                _wide(depth, out, out_at + row * out_step + column, out_step,
                      init, init_at + row * init_step + column, init_step,
                      a, a_at + row * a_step, a_step, a_stride, b, b_at + column,
                      b_step)  # fmt: skip
            done = _WIDE * LANES
        elif width > LANES:
            for row in range(0, rows, _DOUBLE_ROWS):
                _double(depth, out, out_at + row * out_step + column, out_step,
                        init, init_at + row * init_step + column, init_step,
                        a, a_at + row * a_step, a_step, a_stride, b, b_at + column,
                        b_step)  # fmt: skip
            done = 2 * LANES
        else:
            for row in range(0, rows, _SINGLE_ROWS):
                _single(depth, out, out_at + row * out_step + column, out_step,
                        init, init_at + row * init_step + column, init_step,
                        a, a_at + row * a_step, a_step, a_stride, b, b_at + column,
                        b_step)  # fmt: skip
            done = LANES
        column += done
        width -= done


@njit(**INLINE)
def workspace(plan):
    """Hidden values in bfloat16, the same in pairs, and in float32 the results and before them the
    first layer's sums; products may read a little past."""
    room = ROWS * LANES
    hidden = np.zeros(plan[-1, HIDDEN] + BLOCK * plan[-1, OUT_PAD] + 2 * room, np.int16)
    widest = max(plan[0, OUT_PAD], plan[-1, OUT_PAD])
    return hidden, hidden.view(np.int32), np.zeros(BLOCK * widest + room, np.float32)


@njit(**LEAN)
def through_layers(begin, count, x, x_at, x_step, x_stride, network, bias_rows, group, work):
    """As `mlp.through_layers` for `count` samples, inputs x in pairs, bias_rows flat, in rows as
    wide as the first layer's padding; results in work[2], row by row as wide as the last's."""
    plan, weights, biases = network
    hidden, pairs, sums = work
    zero, one = np.int64(0), np.int64(1)
    a, at, step, stride = x, x_at, x_step, x_stride
    for layer in range(len(plan)):
        row = plan[layer]
        wide = row[OUT_PAD]
        init, init_at, init_step = biases, row[BIAS], zero
        if layer == 0 and len(bias_rows) > 0:
            for i in range(count):
                extra = group[begin + i] * wide
                for k in range(0, wide, LANES):
                    more = load(bias_rows, extra + k)
                    store(sums, i * wide + k, load(biases, row[BIAS] + k) + more)
            init, init_at, init_step = sums, zero, wide
        if layer == len(plan) - 1:
            _multiply(count, row[OUT], row[IN], sums, zero, wide, init, init_at, init_step,
                      a, at, step, stride, weights, row[WEIGHT], wide)  # fmt: skip
        else:
            _multiply(count, row[OUT], row[IN], hidden, row[HIDDEN], wide, init, init_at,
                      init_step, a, at, step, stride, weights, row[WEIGHT], wide)  # fmt: skip
        a, at, step, stride = pairs, row[HIDDEN] // 2, wide // 2, one
