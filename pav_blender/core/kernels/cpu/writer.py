"""LLVM instructions on the memory of numba arrays, for intrinsics that work on vectors."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

INT = ir.IntType(32)
LONG = ir.IntType(64)
FLOAT = ir.FloatType()
_FUSE = ("contract",)  # lets LLVM fuse a product and a sum where the processor can


class Writer:
    """Writes an intrinsic's instructions; `values` are its arguments, arrays as plain pointers."""

    def __init__(self, context: Any, builder: Any, signature: Any, values: Any) -> None:
        self.builder = builder
        self.values = [
            cgutils.create_struct_proxy(kind)(context, builder, value).data
            if isinstance(kind, types.Array)
            else value
            for kind, value in zip(signature.args, values, strict=True)
        ]

    def address(self, pointer: Any, at: Any, kind: Any) -> Any:
        return self.builder.bitcast(self.builder.gep(pointer, [at]), kind.as_pointer())

    def load(self, pointer: Any, at: Any, kind: Any) -> Any:
        # Rows begin anywhere: only the alignment of one float is certain.
        return self.builder.load(self.address(pointer, at, kind), align=4)

    def store(self, value: Any, pointer: Any, at: Any) -> None:
        self.builder.store(value, self.address(pointer, at, value.type), align=4)

    def splat(self, value: Any, kind: Any) -> Any:
        """A value in every lane; the value itself where `kind` is no vector."""
        if not isinstance(kind, ir.VectorType):
            return value
        undefined = ir.Constant(kind, ir.Undefined)
        one = self.builder.insert_element(undefined, value, INT(0))
        zeros = ir.Constant(ir.VectorType(INT, kind.count), None)
        return self.builder.shuffle_vector(one, undefined, zeros)

    def as_vector(self, value: Any) -> Any:
        """A number as a vector of one; a vector as it is."""
        if isinstance(value.type, ir.VectorType):
            return value
        return self.splat(value, ir.VectorType(value.type, 1))

    def shortened(self, value: Any) -> Any:
        """float32 numbers, a vector of them, rounded to bfloat16, in int16."""
        count = value.type.count
        whole, short = ir.VectorType(INT, count), ir.VectorType(ir.IntType(16), count)
        half, moved = (ir.Constant(whole, [n] * count) for n in (0x8000, 16))
        bits = self.builder.add(self.builder.bitcast(value, whole), half)
        return self.builder.trunc(self.builder.lshr(bits, moved), short)

    def store_short(self, value: Any, pointer: Any, at: Any) -> None:
        """Numbers, rounded, into an int16 array from element `at` on."""
        short = self.shortened(value)
        self.builder.store(short, self.address(pointer, at, short.type), align=2)

    def product(self, a: Any, b: Any) -> Any:
        return self.builder.fmul(a, b, flags=_FUSE)

    def total(self, a: Any, b: Any) -> Any:
        return self.builder.fadd(a, b, flags=_FUSE)

    def fetch(self, pointer: Any, at: Any) -> None:
        """Ask for the cache line of an element, into the second cache: more requests can wait
        for that one than for the first."""
        place = self.address(pointer, at, ir.IntType(8))
        kind = ir.FunctionType(ir.VoidType(), [place.type, INT, INT, INT])
        prefetch = self.builder.module.declare_intrinsic("llvm.prefetch", [place.type], kind)
        self.builder.call(prefetch, [place, INT(0), INT(2), INT(1)])
