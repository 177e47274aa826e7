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
