"""Vectors of `LANES` values inside numba functions.

Left to itself LLVM vectorises the searches here at a quarter of the speed. These are plain LLVM
vectors, so every target gets them in whatever width it has (AVX-512, AVX2, NEON) without a line of
machine code. `Floats`, `Ints` and `Mask` are values: pass them to and from jitted functions, use
`+ - * < <= == & |` and the functions below on them.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16

_FLOAT = ir.VectorType(ir.FloatType(), LANES)
_INT = ir.VectorType(ir.IntType(32), LANES)
_BOOL = ir.VectorType(ir.IntType(1), LANES)


class _Vector(types.Type):
    def __init__(self, name: str, llvm: ir.VectorType) -> None:
        self.llvm = llvm
        super().__init__(name=f"{name}x{LANES}")


class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: _Vector) -> None:
        super().__init__(manager, kind, kind.llvm)


register_model(_Vector)(_VectorModel)

Floats = _Vector("float32", _FLOAT)
Ints = _Vector("int32", _INT)
Mask = _Vector("mask", _BOOL)


def _define(function: Any, emit: Callable[..., Any], sig: Any) -> None:
    """Give a Python operator a meaning on vectors: `emit(builder, *values)` makes the code."""

    class Template(ConcreteTemplate):
        key = function
        cases = [sig]  # noqa: RUF012

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit(builder, *args)

    infer_global(function)(Template)
    lower_builtin(function, *sig.args)(lower)


_FFF = signature(Floats, Floats, Floats)
_MFF = signature(Mask, Floats, Floats)
_III = signature(Ints, Ints, Ints)
_MII = signature(Mask, Ints, Ints)
_MMM = signature(Mask, Mask, Mask)
_define(operator.add, lambda b, x, y: b.fadd(x, y), _FFF)
_define(operator.sub, lambda b, x, y: b.fsub(x, y), _FFF)
_define(operator.mul, lambda b, x, y: b.fmul(x, y), _FFF)
_define(operator.truediv, lambda b, x, y: b.fdiv(x, y), _FFF)
_define(operator.lt, lambda b, x, y: b.fcmp_ordered("<", x, y), _MFF)
_define(operator.le, lambda b, x, y: b.fcmp_ordered("<=", x, y), _MFF)
_define(operator.eq, lambda b, x, y: b.fcmp_ordered("==", x, y), _MFF)
_define(operator.add, lambda b, x, y: b.add(x, y), _III)
_define(operator.mul, lambda b, x, y: b.mul(x, y), _III)
_define(operator.lt, lambda b, x, y: b.icmp_signed("<", x, y), _MII)
_define(operator.le, lambda b, x, y: b.icmp_signed("<=", x, y), _MII)
_define(operator.eq, lambda b, x, y: b.icmp_signed("==", x, y), _MII)
_define(operator.and_, lambda b, x, y: b.and_(x, y), _MMM)
_define(operator.or_, lambda b, x, y: b.or_(x, y), _MMM)


def _llvm(builder: Any, name: str, result: Any, *args: Any) -> Any:
    """Call an LLVM intrinsic by its full name."""
    kind = ir.FunctionType(result, [value.type for value in args])
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(function, args)


def _broadcast(builder: Any, scalar: Any, kind: ir.VectorType) -> Any:
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.IntType(32)(0))
    order = ir.Constant(_INT, [0] * LANES)
    return builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), order)


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def _kind(array: Any) -> _Vector | None:
    """The vector type of a flat contiguous array's values, None for what cannot be loaded."""
    if not (isinstance(array, types.Array) and array.layout == "C"):
        return None
    return {types.float32: Floats, types.int32: Ints}.get(array.dtype)


@intrinsic
def splat(typingctx, value):
    """A float32 in every lane."""

    def codegen(context, builder, sig, args):
        scalar = context.cast(builder, args[0], sig.args[0], types.float32)
        return _broadcast(builder, scalar, _FLOAT)

    return Floats(value), codegen


@intrinsic
def splat_int(typingctx, value):
    """An int32 in every lane."""

    def codegen(context, builder, sig, args):
        scalar = context.cast(builder, args[0], sig.args[0], types.int32)
        return _broadcast(builder, scalar, _INT)

    return Ints(value), codegen


@intrinsic
def load(typingctx, array, index):
    """`LANES` values of a flat contiguous float32 or int32 array from `index` on."""
    kind = _kind(array)
    if kind is None:
        return None

    def codegen(context, builder, sig, args):
        index = context.cast(builder, args[1], sig.args[1], types.intp)
        pointer = _address(context, builder, sig.args[0], args[0], index)
        return builder.load(builder.bitcast(pointer, kind.llvm.as_pointer()), align=4)

    return kind(array, index), codegen


@intrinsic
def store(typingctx, array, index, vector):
    """Write a vector to a flat contiguous array of its type from `index` on."""
    if _kind(array) is not vector:
        return None

    def codegen(context, builder, sig, args):
        index = context.cast(builder, args[1], sig.args[1], types.intp)
        pointer = _address(context, builder, sig.args[0], args[0], index)
        builder.store(args[2], builder.bitcast(pointer, args[2].type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, index, vector), codegen


@intrinsic
def gather(typingctx, array, indices, offset):
    """The values of a flat array at `indices` + offset."""
    kind = _kind(array)
    if kind is None or indices is not Ints:
        return None

    def codegen(context, builder, sig, args):
        offset = context.cast(builder, args[2], sig.args[2], types.intp)
        start = _address(context, builder, sig.args[0], args[0], offset)
        result = ir.Constant(kind.llvm, ir.Undefined)
        for number in range(LANES):
            place = ir.IntType(32)(number)
            index = builder.sext(builder.extract_element(args[1], place), ir.IntType(64))
            value = builder.load(builder.gep(start, [index]))
            result = builder.insert_element(result, value, place)
        return result

    return kind(array, indices, offset), codegen


@intrinsic
def fma(typingctx, x, y, z):
    """x * y + z, fused where the machine can."""

    def codegen(context, builder, sig, args):
        return _llvm(builder, f"llvm.fmuladd.v{LANES}f32", _FLOAT, *args)

    return Floats(x, y, z), codegen


@intrinsic
def minimum(typingctx, x, y):
    """The smaller of each pair; y where either is not a number."""

    def codegen(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return Floats(x, y), codegen


@intrinsic
def maximum(typingctx, x, y):
    """The larger of each pair; y where either is not a number."""

    def codegen(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return Floats(x, y), codegen


@intrinsic
def square_root(typingctx, x):
    """The square root of each lane."""

    def codegen(context, builder, sig, args):
        return _llvm(builder, f"llvm.sqrt.v{LANES}f32", _FLOAT, *args)

    return Floats(x), codegen


@intrinsic
def select(typingctx, mask, x, y):
    """x where the mask holds, y elsewhere (both Floats or both Ints)."""
    if x is not y:
        return None

    def codegen(context, builder, sig, args):
        return builder.select(*args)

    return x(mask, x, y), codegen


@intrinsic
def bits(typingctx, mask):
    """The mask as an integer, lane 0 in bit 0."""

    def codegen(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(64))

    return types.int64(mask), codegen


@intrinsic
def lowest_bit(typingctx, word):
    """Index of the lowest bit set; the word must not be 0."""

    def codegen(context, builder, sig, args):
        return builder.cttz(args[0], ir.IntType(1)(1))

    return types.int64(types.int64), codegen


@intrinsic
def lane(typingctx, vector, index):
    """The value in one lane."""
    kind = types.float32 if vector is Floats else types.int32

    def codegen(context, builder, sig, args):
        index = context.cast(builder, args[1], sig.args[1], types.int32)
        return builder.extract_element(args[0], index)

    return kind(vector, index), codegen


@intrinsic
def largest(typingctx, vector):
    """The largest lane (none may be NaN)."""

    def codegen(context, builder, sig, args):
        name = f"llvm.vector.reduce.fmax.v{LANES}f32"
        return _llvm(builder, name, ir.FloatType(), *args)

    return types.float32(vector), codegen


@intrinsic
def smallest(typingctx, vector):
    """The smallest lane (none may be NaN)."""

    def codegen(context, builder, sig, args):
        name = f"llvm.vector.reduce.fmin.v{LANES}f32"
        return _llvm(builder, name, ir.FloatType(), *args)

    return types.float32(vector), codegen


@intrinsic
def to_float(typingctx, vector):
    """Ints as Floats."""

    def codegen(context, builder, sig, args):
        return builder.sitofp(args[0], _FLOAT)

    return Floats(vector), codegen


@intrinsic
def to_int(typingctx, vector):
    """Floats as Ints, towards zero; they must fit."""

    def codegen(context, builder, sig, args):
        return builder.fptosi(args[0], _INT)

    return Ints(vector), codegen
