"""Matrix products of bfloat16 numbers with float32 sums, for networks that are only read.

A processor that multiplies pairs of bfloat16 numbers (AVX-512 BF16) does so at twice the rate of
float32 and reads half the bytes. Two numbers that follow one another along the depth of a product
lie in one int32, the first in its lower half. Rounding is to the nearest, halves away from zero.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import njit, types
from numba.extending import intrinsic

from .tiles import _PAIR, _PAIR_ROWS, _SINGLE_ROWS, _WIDE, _WIDE_ROWS, LANES, _Tile

_INT, _SHORT = ir.IntType(32), ir.IntType(16)


def available() -> bool:
    """Whether this processor multiplies pairs; PAV_FLOAT32=1 in the environment says no."""
    if os.environ.get("PAV_FLOAT32"):
        return False
    return bool(dict(binding.get_host_cpu_features()).get("avx512bf16"))


class _Brief(ir.Type):
    """LLVM's bfloat, which llvmlite has no name for."""

    def _to_string(self) -> str:
        return "bfloat"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Brief)

    def __hash__(self) -> int:
        return hash(_Brief)


def shortened(builder: Any, value: Any) -> Any:
    """float32 numbers (a vector or one) as bfloat16, in int16."""
    count = getattr(value.type, "count", None)
    whole, short = _INT, _SHORT
    half = _INT(0x8000)
    if count is not None:
        whole, short = ir.VectorType(_INT, count), ir.VectorType(_SHORT, count)
        half = ir.Constant(whole, [0x8000] * count)
    bits = builder.add(builder.bitcast(value, whole), half)
    moved = builder.lshr(bits, whole(16) if count is None else ir.Constant(whole, [16] * count))
    return builder.trunc(moved, short)


class _PairTile(_Tile):
    """out = finish(init + a @ b), a and b [depth of pairs] int32; out float32 as it is, or int16
    with what is below zero left out."""

    def __init__(self, context: Any, builder: Any, signature: Any, values: Any) -> None:
        super().__init__(context, builder, signature, values)
        self.kinds = {"b": ir.VectorType(_INT, LANES)}
        self.brief = signature.args[2].dtype == types.int16
        pairs = ir.VectorType(_Brief(), 2 * LANES)
        kind = ir.FunctionType(self.vector, [self.vector, pairs, pairs])
        self.pairs = pairs
        name = "llvm.x86.avx512bf16.dpbf16ps.512"
        module = builder.module
        self.dot = module.globals.get(name) or ir.Function(module, kind, name)

    def load(self, name: str, row: int, column: int, along: Any = None) -> Any:
        kind = self.kinds.get(name, self.vector)
        pointer = self.address(name, row, column, along)
        return self.builder.load(self.builder.bitcast(pointer, kind.as_pointer()), align=4)

    def broadcast(self, value: Any) -> Any:
        kind = self.kinds["b"]
        one = self.builder.insert_element(ir.Constant(kind, ir.Undefined), value, _INT(0))
        zeros = ir.Constant(kind, None)
        return self.builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), zeros)

    def add_product(self, total: Any, left: Any, right: Any) -> Any:
        builder = self.builder
        return builder.call(
            self.dot, [total, builder.bitcast(left, self.pairs), builder.bitcast(right, self.pairs)]
        )

    def finish(self, results: list[Any], vectors: int) -> None:
        builder = self.builder
        zero = ir.Constant(self.vector, None)
        for i, result in enumerate(results):
            row, column = divmod(i, vectors)
            value = result
            if self.brief:
                keep = builder.fcmp_unordered(">", result, zero)
                value = shortened(builder, builder.select(keep, result, zero))
            pointer = self.address("out", row, column)
            builder.store(value, builder.bitcast(pointer, value.type.as_pointer()), align=2)


def _tile(rows: int, vectors: int) -> Any:
    @intrinsic
    def tile(typing, depth, finish, out, out_at, out_step, init, init_at, init_step,
             a, a_at, a_step, a_stride, b, b_at, b_step, mask, mask_at, mask_step):  # fmt: skip
        kinds = (depth, finish, out, out_at, out_step, init, init_at, init_step,
                 a, a_at, a_step, a_stride, b, b_at, b_step, mask, mask_at, mask_step)  # fmt: skip

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            writer = _PairTile(context, builder, signature, values)
            writer.finish(writer.accumulate(rows, vectors), vectors)
            return context.get_dummy_value()

        return types.void(*kinds), generate

    return tile
