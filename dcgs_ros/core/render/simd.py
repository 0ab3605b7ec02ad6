# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Explicit SIMD for Numba kernels: arithmetic on vectors of LANES floats, written as LLVM IR.

LLVM does not vectorise the inner loops of the renderer by itself (they alias, and branch), which
costs a factor of five. Numba lets an `@intrinsic` emit IR: a `Vector` stands for a value of type
<16 x float> in the code being emitted, and its operators append instructions to that code. LLVM
splits such vectors into what the machine has: one AVX-512 register, two of AVX2, four of SSE or
NEON. These functions run when a kernel is compiled, and do not depend on the machine.

Reassociation is allowed instruction by instruction, but not for the rounding trick of `exp2`. The
flags of a kernel would break that: `jit.strict_kernel` has none. Numba's cache does not notice
changes in this file: `jit` names the cache folder by its contents.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils

LANES = 16
_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
_INDEX = ir.IntType(64)
_FLOATS, _INTS = ir.VectorType(_FLOAT, LANES), ir.VectorType(_INT, LANES)
_FLAGS = ('contract', 'reassoc', 'nsz', 'arcp')
_ROUNDER = 1.5 * 2.0**23  # added to |x| < 2^22, leaves the nearest integer in the low bits
_EXPONENT_BIT = 23
_LOG2_SPLIT = 0x3F400000  # bits of 0.75: mantissas are taken from [0.75, 1.5)
_LIMIT = 120.0  # largest exponent that `exp` passes to exp2


def _fitted(function: Any, low: float, high: float, degree: int) -> list[float]:
    """Return the coefficients, constant first, of a polynomial with a small relative error.

    A least squares fit at Chebyshev nodes between `low` and `high`.
    """
    nodes = 0.5 * (high + low + (high - low) * np.cos(np.pi * (np.arange(400) + 0.5) / 400))
    values = function(nodes)
    basis = np.vander(nodes, degree + 1, increasing=True) / values[:, None]
    fitted: list[float] = np.linalg.lstsq(basis, np.ones_like(nodes), rcond=None)[0].tolist()
    return fitted


_EXP2 = {degree: _fitted(np.exp2, -0.5, 0.5, degree) for degree in (4, 6)}
_LOG2 = _fitted(lambda t: np.log2(1 + t) / t, -0.25, 0.5, 8)  # of log2(1 + t) / t


class Vector:
    """A vector of LANES floats in the code being emitted."""

    __slots__ = ('builder', 'value')

    def __init__(self, builder: Any, value: Any) -> None:
        """Wrap an IR value of type <16 x float>."""
        self.builder = builder
        self.value = value

    def _with(self, operation: str, left: Any, right: Any) -> Vector:
        emit = getattr(self.builder, operation)
        return Vector(self.builder, emit(self._value(left), self._value(right), flags=_FLAGS))

    def _value(self, operand: Any) -> Any:
        return operand.value if isinstance(operand, Vector) else _constant(operand)

    def __add__(self, other: Any) -> Vector:
        return self._with('fadd', self, other)

    def __sub__(self, other: Any) -> Vector:
        return self._with('fsub', self, other)

    def __rsub__(self, other: Any) -> Vector:
        return self._with('fsub', other, self)

    def __mul__(self, other: Any) -> Vector:
        return self._with('fmul', self, other)

    def __truediv__(self, other: Any) -> Vector:
        return self._with('fdiv', self, other)

    def __rtruediv__(self, other: Any) -> Vector:
        return self._with('fdiv', other, self)

    def __neg__(self) -> Vector:
        return 0.0 - self

    __radd__, __rmul__ = __add__, __mul__

    def _compared(self, operator: str, other: Any) -> Any:
        """Return a mask of the lanes where it holds; it never holds for NaN."""
        return self.builder.fcmp_ordered(operator, self.value, self._value(other))

    def __gt__(self, other: Any) -> Any:
        return self._compared('>', other)

    def __ge__(self, other: Any) -> Any:
        return self._compared('>=', other)

    def __lt__(self, other: Any) -> Any:
        return self._compared('<', other)

    def __le__(self, other: Any) -> Any:
        return self._compared('<=', other)


def _constant(number: float) -> Any:
    return ir.Constant(_FLOATS, [float(np.float32(number))] * LANES)


def _integers(number: int) -> Any:
    return ir.Constant(_INTS, [number] * LANES)


def index(number: int) -> Any:
    """Return a constant index, an IR value."""
    return ir.Constant(_INDEX, number)


def constant(builder: Any, lanes: float | Sequence[float]) -> Vector:
    """Return one number in all lanes, or one number for each lane."""
    numbers = [lanes] * LANES if isinstance(lanes, int | float) else lanes
    return Vector(builder, ir.Constant(_FLOATS, [float(np.float32(x)) for x in numbers]))


def spread(builder: Any, scalar: Any) -> Vector:
    """Return a float computed at run time, an IR value, in all lanes."""
    undefined = ir.Constant(_FLOATS, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_INT, 0))
    return Vector(builder, builder.shuffle_vector(first, undefined, _integers(0)))


def pointer(context: Any, builder: Any, array_type: Any, array: Any) -> Any:
    """Return the address of a contiguous float32 array argument's first element."""
    return context.make_array(array_type)(context, builder, array).data


def scalar_at(builder: Any, base: Any, offset: int) -> Vector:
    """Return the float `offset` elements behind `base` in all lanes."""
    return spread(builder, builder.load(builder.gep(base, [index(offset)])))


def load(builder: Any, base: Any, offset: Any, align: int = 4) -> Vector:
    """Return the LANES floats from `offset` (an IR index) elements behind `base`."""
    at = builder.bitcast(builder.gep(base, [offset]), _FLOATS.as_pointer())
    return Vector(builder, builder.load(at, align=align))


def store(builder: Any, base: Any, offset: Any, vector: Vector, align: int = 4) -> None:
    """Write LANES floats to `offset` (an IR index) elements behind `base`."""
    at = builder.bitcast(builder.gep(base, [offset]), _FLOATS.as_pointer())
    builder.store(vector.value, at, align=align)


class Accumulator:
    """A sum that a loop in the emitted code adds to; LLVM keeps it in a register."""

    def __init__(self, builder: Any) -> None:
        """Start at zero."""
        self._builder = builder
        self._place = cgutils.alloca_once_value(builder, _constant(0.0))
        builder.store(_constant(0.0), self._place)

    def add(self, vector: Vector) -> None:
        """Add a vector."""
        self._builder.store((self.total + vector).value, self._place)

    @property
    def total(self) -> Vector:
        """The sum so far, lane by lane."""
        return Vector(self._builder, self._builder.load(self._place))


def both(first: Any, second: Any, *more: Any, builder: Any) -> Any:
    """Return the lanes where all masks hold."""
    mask = builder.and_(first, second)
    for other in more:
        mask = builder.and_(mask, other)
    return mask


def select(mask: Any, yes: Vector | float, no: Vector | float, builder: Any) -> Vector:
    """Return `yes` in the lanes of the mask, `no` in the others."""
    values = [x.value if isinstance(x, Vector) else _constant(x) for x in (yes, no)]
    return Vector(builder, builder.select(mask, *values))


def minimum(x: Vector, y: Vector | float) -> Vector:
    """Return the smaller one, lane by lane; y where x is NaN."""
    return select(x < y, x, y, x.builder)


def maximum(x: Vector, y: Vector | float) -> Vector:
    """Return the larger one, lane by lane; y where x is NaN."""
    return select(x > y, x, y, x.builder)


def sqrt(x: Vector) -> Vector:
    """Return the square root, lane by lane."""
    kind = ir.FunctionType(_FLOATS, [_FLOATS])
    name = f'llvm.sqrt.v{LANES}f32'
    function = cgutils.get_or_insert_function(x.builder.module, kind, name)
    return Vector(x.builder, x.builder.call(function, [x.value], fastmath=_FLAGS))


def exp2(x: Vector, degree: int = 4) -> Vector:
    """Return 2^x for |x| < 126, undefined beyond; relative error 4e-6 (degree 4) or 2e-7 (6)."""
    builder = x.builder
    rounder = _constant(_ROUNDER)
    shifted = builder.fadd(x.value, rounder)  # no flags: this is the rounding
    rest = Vector(builder, builder.fsub(x.value, builder.fsub(shifted, rounder)))
    power = _polynomial(rest, _EXP2[degree])
    exponent = builder.shl(builder.bitcast(shifted, _INTS), _integers(_EXPONENT_BIT))
    bits = builder.add(builder.bitcast(power.value, _INTS), exponent)
    return Vector(builder, builder.bitcast(bits, _FLOATS))


def exp(x: Vector) -> Vector:
    """Return e^x, clamped to 2^-120 ... 2^120."""
    exponent = x * float(np.log2(np.e))
    return exp2(minimum(maximum(exponent, -_LIMIT), _LIMIT), 6)


def log2(x: Vector) -> Vector:
    """Return log2 of positive, normal x; absolute error about 3e-7."""
    builder = x.builder
    bits = builder.bitcast(x.value, _INTS)
    whole = builder.ashr(builder.sub(bits, _integers(_LOG2_SPLIT)), _integers(_EXPONENT_BIT))
    mantissa = builder.sub(bits, builder.shl(whole, _integers(_EXPONENT_BIT)))
    rest = Vector(builder, builder.bitcast(mantissa, _FLOATS)) - 1.0
    return Vector(builder, builder.sitofp(whole, _FLOATS)) + rest * _polynomial(rest, _LOG2)


def _polynomial(x: Vector, coefficients: Sequence[float]) -> Vector:
    result = constant(x.builder, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        result = result * x + coefficient
    return result


def sums(vectors: Sequence[Vector]) -> Vector:
    """Return a vector whose lane k is the sum of the k-th of at most LANES vectors.

    Pairs of vectors are folded into one, in four rounds: 15 additions for 16 sums.
    """
    builder = vectors[0].builder
    even = [2 * k for k in range(LANES)]
    picks = [ir.Constant(_INTS, [i + odd for i in even]) for odd in (0, 1)]
    values = [v.value for v in vectors]
    values += [_constant(0.0)] * (LANES - len(values))
    while len(values) > 1:
        pairs = zip(values[::2], values[1::2], strict=True)
        values = [
            builder.fadd(
                builder.shuffle_vector(a, b, picks[0]), builder.shuffle_vector(a, b, picks[1]),
                flags=_FLAGS,
            )
            for a, b in pairs
        ]  # fmt: skip
    return Vector(builder, values[0])
