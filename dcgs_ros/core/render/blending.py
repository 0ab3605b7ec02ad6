# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The innermost loops of the CPU renderer: blend one Gaussian into a tile, and its derivatives.

A tile is TILE x TILE pixels, stored in blocks of 4 x 4 = LANES pixels so that a small Gaussian
touches few. Each block is a few consecutive vectors; those of a tile fit into the first-level
cache. The backward pass goes front to back too: what is behind a Gaussian is the total minus what
is in front of it, so the forward pass stores nothing for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .renderer import ALPHA_MAX, ALPHA_MIN, T_MIN
from .simd import (
    LANES,
    Accumulator,
    Vector,
    constant,
    exp2,
    index,
    load,
    maximum,
    minimum,
    pointer,
    select,
    spread,
    store,
    sums,
)

TILE = 32
BLOCK = 4  # pixels along a block's side
BLOCKS = TILE // BLOCK  # along a tile's side
FORWARD = 5  # vectors of a block: transmittance, red, green, blue, depth (metres)
BACKWARD = 6  # transmittance, sum over what is behind, gradients by red, green, blue, depth
FORWARD_SIZE = BLOCKS * BLOCKS * FORWARD * LANES
BACKWARD_SIZE = BLOCKS * BLOCKS * BACKWARD * LANES

# A projected Gaussian is a row of 16 floats, one cache line: position and reach in pixels, conic,
# log2 of the opacity, colour, depth in metres.
X, Y, A, B, C, LOG2_OPACITY, RED, GREEN, BLUE, DEPTH, REACH_X, REACH_Y = range(12)
ROW = 16
LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)

# Each pair of Gaussian and tile has a row of gradient sums: of v = alpha dL/dalpha, of v times the
# powers of the distance to the mean, of the gradients by colour and depth, and of the weight.
SUMS = 11

_INDEX, _FLOAT = ir.IntType(64), ir.FloatType()


def _each_block(
    builder: Any,
    row: Any,
    bounds: tuple[Any, Any, Any, Any],
    tile_xy: tuple[Any, Any],
    body: Callable[[Any, Vector, Vector, Vector], None],
) -> None:
    """Emit a loop over the blocks within bounds (first and last column, first and last row).

    `body(block, dx, dy, power)` gets the block's number, the distance of its pixels from the mean,
    pixels, and log2 of their alpha. A, B, C of a row are the conic times log2 e.
    """

    def of_row(k: int) -> Vector:
        return spread(builder, builder.load(builder.gep(row, [index(k)])))

    mean_x, mean_y, log2_opacity = of_row(X), of_row(Y), of_row(LOG2_OPACITY)
    half_a, minus_b, half_c = of_row(A) * -0.5, -of_row(B), of_row(C) * -0.5
    column = constant(builder, [k % BLOCK + 0.5 for k in range(LANES)])
    line = constant(builder, [k // BLOCK + 0.5 for k in range(LANES)])
    first_dx = column + (spread(builder, tile_xy[0]) - mean_x)
    first_dy = line + (spread(builder, tile_xy[1]) - mean_y)
    x0, x1, y0, y1 = bounds
    ends = builder.add(x1, index(1)), builder.add(y1, index(1))

    def along(first: Vector, block: Any) -> Vector:
        pixels = builder.mul(block, index(BLOCK))
        return first + spread(builder, builder.sitofp(pixels, _FLOAT))

    with cgutils.for_range_slice(builder, x0, ends[0], index(1), inc=True) as (block_x, _):
        dx = along(first_dx, block_x)
        of_column, slope = log2_opacity + half_a * dx * dx, minus_b * dx
        with cgutils.for_range_slice(builder, y0, ends[1], index(1), inc=True) as (block_y, _):
            dy = along(first_dy, block_y)
            power = of_column + dy * (half_c * dy + slope)
            body(builder.add(builder.mul(block_y, index(BLOCKS)), block_x), dx, dy, power)


def _blended(builder: Any, T: Vector, power: Vector) -> tuple[Vector, Vector, Vector, Vector]:
    """Return alpha before its upper bound, alpha, weight, and the transmittance behind.

    The transmittance of a pixel that has ended is kept, with a negative sign.
    """
    unbounded = exp2(power)
    visible = power >= LOG2_ALPHA_MIN
    alpha = select(visible, minimum(unbounded, ALPHA_MAX), 0.0, builder)
    behind = T - alpha * T
    open_ = behind > T_MIN
    alpha = select(open_, alpha, 0.0, builder)
    return unbounded, alpha, alpha * T, select(open_, behind, minimum(T, -T), builder)


@intrinsic
def blend(typing, tile, row, x0, x1, y0, y1, tile_x, tile_y):
    """Blend one projected Gaussian behind what `tile` holds, and write the result there.

    `tile` (FORWARD_SIZE,) float32, `row` (ROW,) float32; x0, x1, y0, y1 are the first and last
    column and row of blocks; (tile_x, tile_y) is the tile's corner, pixels.
    """
    bounds = [types.int64] * 4
    signature = types.void(tile, row, *bounds, types.float32, types.float32)

    def emit(context, builder, signature, arguments):
        base = pointer(context, builder, signature.args[0], arguments[0])
        row = pointer(context, builder, signature.args[1], arguments[1])
        color = [
            spread(builder, builder.load(builder.gep(row, [index(k)])))
            for k in (RED, GREEN, BLUE, DEPTH)
        ]

        def body(block, dx, dy, power):
            at = builder.mul(block, index(FORWARD * LANES))
            T = load(builder, base, at, 4 * LANES)
            _, _, weight, behind = _blended(builder, T, power)
            store(builder, base, at, behind, 4 * LANES)
            for k, value in enumerate(color):
                place = builder.add(at, index((k + 1) * LANES))
                sum_ = load(builder, base, place, 4 * LANES) + weight * value
                store(builder, base, place, sum_, 4 * LANES)

        _each_block(builder, row, tuple(arguments[2:6]), tuple(arguments[6:8]), body)
        return context.get_dummy_value()

    return signature, emit


@intrinsic
def blend_backward(typing, tile, row, x0, x1, y0, y1, tile_x, tile_y, out, slot):
    """Sum the derivatives by one projected Gaussian over a tile; write row `slot` of `out`.

    `tile` (BACKWARD_SIZE,) float32 is updated, `row` (ROW,) float32, `out` (P, ROW) float32; the
    bounds and the corner are as in `blend`. The chain rule continues from log2 alpha, so
    v = alpha dL/dalpha is summed: with w the weight, g the gradient at a pixel and S the sum of
    w (c . g) over what is behind, v = w (c . g) - alpha / (1 - alpha) S, and 0 where alpha is at
    its upper bound.
    """
    bounds = [types.int64] * 4
    signature = types.void(tile, row, *bounds, types.float32, types.float32, out, types.int64)

    def emit(context, builder, signature, arguments):
        base = pointer(context, builder, signature.args[0], arguments[0])
        row = pointer(context, builder, signature.args[1], arguments[1])
        out = pointer(context, builder, signature.args[8], arguments[8])
        color = [
            spread(builder, builder.load(builder.gep(row, [index(k)])))
            for k in (RED, GREEN, BLUE, DEPTH)
        ]
        totals = [Accumulator(builder) for _ in range(SUMS)]

        def body(block, dx, dy, power):
            at = builder.mul(block, index(BACKWARD * LANES))

            def held(k):
                return load(builder, base, builder.add(at, index(k * LANES)), 4 * LANES)

            T, behind_sum = held(0), held(1)
            unbounded, alpha, weight, behind = _blended(builder, T, power)
            gradient = [held(2 + k) for k in range(4)]
            shown = color[0] * gradient[0]
            for value, g in zip(color[1:], gradient[1:], strict=True):
                shown = shown + value * g
            shown = shown * weight
            behind_sum = behind_sum - shown
            store(builder, base, builder.add(at, index(LANES)), behind_sum, 4 * LANES)
            store(builder, base, at, behind, 4 * LANES)
            v = shown - alpha * behind_sum / (1.0 - alpha)
            v = select(unbounded < ALPHA_MAX, v, 0.0, builder)
            vx, vy = v * dx, v * dy
            terms = [v, vx, vy, vx * dx, vx * dy, vy * dy]
            terms += [weight * g for g in gradient] + [weight]
            for total, term in zip(totals, terms, strict=True):
                total.add(term)

        _each_block(builder, row, tuple(arguments[2:6]), tuple(arguments[6:8]), body)
        place = builder.mul(arguments[9], index(ROW))
        store(builder, out, place, sums([t.total for t in totals]), 4 * LANES)
        return context.get_dummy_value()

    return signature, emit


@intrinsic
def all_ended(typing, tile):
    """Return whether every pixel of `tile` (FORWARD_SIZE,), as `blend` leaves it, has ended."""

    def emit(context, builder, signature, arguments):
        base = pointer(context, builder, signature.args[0], arguments[0])
        place = cgutils.alloca_once_value(builder, constant(builder, -1.0).value)
        builder.store(constant(builder, -1.0).value, place)
        last = index(BLOCKS * BLOCKS)
        with cgutils.for_range_slice(builder, index(0), last, index(1), inc=True) as (block, _):
            T = load(builder, base, builder.mul(block, index(FORWARD * LANES)), 4 * LANES)
            best = Vector(builder, builder.load(place))
            builder.store(maximum(best, T).value, place)
        best = Vector(builder, builder.load(place))
        lanes = builder.bitcast((best > 0.0), ir.IntType(LANES))
        return builder.icmp_unsigned('==', lanes, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(tile), emit
