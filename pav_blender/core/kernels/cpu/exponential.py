"""Exponentials of `LANES` values at once, for use inside compiled kernels.

e^x is 2^n e^r with |r| <= ln 2 / 2. What is worked out is p = e^r - 1: with it small powers keep
their digits where 1 is taken away.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit
from numba.extending import intrinsic

from .lanes import LANES, Floats, fma, load, maximum, minimum, splat, store

_FLOATS, _INTS = Floats.llvm, ir.VectorType(ir.IntType(32), LANES)
_PER_LN2 = np.float32(1 / np.log(2))
# ln 2 in two parts, the first with so few digits that n times it is exact
_LN2 = np.float32(0.693359375), np.float32(np.log(2) - 0.693359375)
_LOWEST, _HIGHEST = np.float32(-87.0), np.float32(88.0)  # 2^n is a normal number between them
_ROUND = np.float32(12582912.0)  # 1.5 * 2^23: what is added to it loses its fraction
# of (e^r - 1 - r) / r^2, Taylor's: the first that is left out adds 4e-9 of p
_SERIES = tuple(np.float32(1 / n) for n in (2, 6, 24, 120, 720, 5040))


@intrinsic
def _power_of_two(typing, shifted):
    """2^n of n + 1.5 * 2^23, from its lowest bits."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        word = builder.bitcast(values[0], _INTS)
        one = ir.Constant(_INTS, [127] * LANES)
        bits = builder.shl(builder.add(word, one), ir.Constant(_INTS, [23] * LANES))
        return builder.bitcast(bits, _FLOATS)

    return Floats(shifted), generate


@njit(inline="always")
def parts(x):
    """s and p of e^x = s + s p, for x from -87 to 88; beyond that of the nearer of the two."""
    x = minimum(splat(_HIGHEST), maximum(splat(_LOWEST), x))
    shifted = fma(x, splat(_PER_LN2), splat(_ROUND))
    n = shifted - splat(_ROUND)
    r = fma(n, splat(-_LN2[0]), x)
    r = fma(n, splat(-_LN2[1]), r)
    series = splat(_SERIES[5])
    series = fma(series, r, splat(_SERIES[4]))
    series = fma(series, r, splat(_SERIES[3]))
    series = fma(series, r, splat(_SERIES[2]))
    series = fma(series, r, splat(_SERIES[1]))
    series = fma(series, r, splat(_SERIES[0]))
    return _power_of_two(shifted), fma(series, r * r, r)


@njit(inline="always")
def exp(x):
    """e^x, to 2e-7 of itself for x from -87 to 88; beyond that of the nearer of the two, and of
    what is not a number it is none."""
    s, p = parts(x)
    return fma(s, p, s)


@njit(cache=True, nogil=True)
def exp_all(values, count):
    """e^x in place of the first `count` values, and of what is left of a vector."""
    for i in range(0, count, LANES):
        store(values, i, exp(load(values, i)))
