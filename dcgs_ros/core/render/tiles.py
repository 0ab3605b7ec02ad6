# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The phases of the CPU renderer: each kernel is one, and calls projection or blending.

The first arguments of a phase are (piece, pieces); pieces may run in any order. Gaussians are
split into ranges of whole groups of LANES; tile t belongs to piece t % pieces. Arrays: `planes`
(14, N) float32 as in `Splats`; `camera` (23,) float32 of `camera_numbers`; `rows` (N, ROW) float32
of `blending`; `tile_counts` (N,) int32 tiles that each Gaussian reaches; `first_slots` (N,) int64
first row of each Gaussian in the gradient sums; `tile_starts` (T + 1,) and `tile_ends` (T,) int64
range of each tile in the list of pairs; `pair_row`, `pair_slot` (P,) int32 Gaussian of each pair
and its row in the gradient sums. N is a multiple of LANES.
"""

from __future__ import annotations

import math

import numpy as np

from ..kernels.jit import strict_inlined, strict_kernel
from .blending import (
    BACKWARD,
    BACKWARD_SIZE,
    BLOCK,
    BLOCKS,
    DEPTH,
    FORWARD,
    FORWARD_SIZE,
    LOG2_ALPHA_MIN,
    LOG2_OPACITY,
    REACH_X,
    REACH_Y,
    SUMS,
    TILE,
    A,
    B,
    C,
    X,
    Y,
    all_ended,
    blend,
    blend_backward,
)
from .projection import GRADIENTS, PROJECTED, chain, project
from .simd import LANES

_PARAMETERS = GRADIENTS - 6
# Plain numbers would turn the arithmetic into double precision.
_0, _1, _HALF, _TWO = np.float32(0.0), np.float32(1.0), np.float32(0.5), np.float32(2.0)
_LN_2, _TILE, _PER_TILE = np.float32(math.log(2.0)), np.float32(TILE), np.float32(1.0 / TILE)
_LOG2_ALPHA_MIN = np.float32(LOG2_ALPHA_MIN)
_SORT_BITS = 9  # of a pass; three passes order depths exactly up to a ratio of 2^16


@strict_inlined
def _aligned(size):
    """Return (size,) float32, uninitialised, that starts on a cache line.

    A vector across two cache lines takes twice as long to load.
    """
    raw = np.empty(size + LANES, np.float32)
    first = (-(raw.ctypes.data >> 2)) & (LANES - 1)
    return raw[first : first + size]


@strict_inlined
def _range(piece, pieces, count):
    """Return the first Gaussian of a piece and the one after its last."""
    groups = count // LANES
    return piece * groups // pieces * LANES, (piece + 1) * groups // pieces * LANES


@strict_inlined
def _span(low, high, tiles):
    """Return the first and last of `tiles` tiles that an interval, pixels, meets.

    If it meets none, last < first.
    """
    first = int(max(low, _0) * _PER_TILE)
    last = int(min(max(high, -_1), tiles * _TILE - _1) * _PER_TILE)
    return first, last if high >= _0 else -1


@strict_inlined
def _tile_columns(row, tile_y, tiles_x):
    """Return the first and last tile, in row `tile_y` of tiles, that a Gaussian reaches.

    `row` (ROW,) float32 of `blending`; the Gaussian reaches what its ellipse of ALPHA_MIN meets.
    In a band of y the ellipse's rightmost point is that of the whole ellipse, or the one at the
    end of the band nearest to it.
    """
    a, b, c = row[A] * _LN_2, row[B] * _LN_2, row[C] * _LN_2
    squared = _TWO * _LN_2 * (row[LOG2_OPACITY] - _LOG2_ALPHA_MIN)
    low = max(np.float32(tile_y * TILE) - row[Y], -row[REACH_Y])
    high = min(np.float32((tile_y + 1) * TILE) - row[Y], row[REACH_Y])
    det = max(a * c - b * b, _0)
    at_right = -b * row[REACH_X] / c
    y_right = min(max(at_right, low), high)
    y_left = min(max(-at_right, low), high)
    right = math.sqrt(max(_0, squared * a - det * y_right * y_right))
    left = math.sqrt(max(_0, squared * a - det * y_left * y_left))
    x_right = min(row[X] + (-b * y_right + right) / a, row[X] + row[REACH_X])
    x_left = max(row[X] + (-b * y_left - left) / a, row[X] - row[REACH_X])
    return _span(x_left, x_right, tiles_x)


@strict_kernel
def project_all(piece, pieces, planes, camera, tiles_x, tiles_y, rows, tile_counts, histogram):
    """Project the piece's Gaussians and count their pairs with tiles.

    Writes `rows` (N, ROW), `tile_counts` (N,) and row `piece` of `histogram` (pieces, T) int64:
    the piece's Gaussians in each tile. Reads `planes` (14, N) and `camera` (23,).
    """
    first, last = _range(piece, pieces, planes.shape[1])
    counts = histogram[piece]
    counts[:] = 0
    out = _aligned(PROJECTED * LANES)
    for start in range(first, last, LANES):
        project(planes, planes.shape[1], start, camera, out)
        for lane in range(LANES):
            tile_counts[start + lane] = 0
            if out[(PROJECTED - 1) * LANES + lane] == 0:
                continue
            row = rows[start + lane]
            for k in range(PROJECTED - 1):
                row[k] = out[k * LANES + lane]
            top, bottom = _span(row[Y] - row[REACH_Y], row[Y] + row[REACH_Y], tiles_y)
            left, right = _span(row[X] - row[REACH_X], row[X] + row[REACH_X], tiles_x)
            if top == bottom and left == right:
                counts[top * tiles_x + left] += 1
                tile_counts[start + lane] = 1
                continue
            total = 0
            for tile_y in range(top, bottom + 1):
                left, right = _tile_columns(row, tile_y, tiles_x)
                for tile_x in range(left, right + 1):
                    counts[tile_y * tiles_x + tile_x] += 1
                total += max(0, right - left + 1)
            tile_counts[start + lane] = total


@strict_kernel
def lay_out(tile_counts, histogram, first_slots, tile_starts):
    """Turn counts into positions; return the number of pairs.

    Writes `first_slots` (N,) and `tile_starts` (T + 1,), and turns the counts in `histogram`
    (pieces, T) into the place of each piece's first pair in a tile. Reads `tile_counts` (N,).
    """
    slot = 0
    for i in range(len(tile_counts)):
        first_slots[i] = slot
        slot += tile_counts[i]
    place = 0
    for tile in range(histogram.shape[1]):
        tile_starts[tile] = place
        for piece in range(histogram.shape[0]):
            count = histogram[piece, tile]
            histogram[piece, tile] = place
            place += count
    tile_starts[histogram.shape[1]] = place
    return slot


@strict_kernel
def scatter(
    piece, pieces, tiles_x, tiles_y, rows, tile_counts, first_slots, places, pair_row, pair_slot
):
    """Write the piece's pairs of Gaussian and tile into the lists of their tiles.

    Writes `pair_row`, `pair_slot` (P,) and advances row `piece` of `places` (pieces, T), the
    histogram of `lay_out`. Reads `rows` (N, ROW), `tile_counts` and `first_slots` (N,).
    """
    first, last = _range(piece, pieces, len(tile_counts))
    next_place = places[piece]
    for i in range(first, last):
        if tile_counts[i] == 0:
            continue
        row, slot = rows[i], first_slots[i]
        top, bottom = _span(row[Y] - row[REACH_Y], row[Y] + row[REACH_Y], tiles_y)
        left, right = _span(row[X] - row[REACH_X], row[X] + row[REACH_X], tiles_x)
        for tile_y in range(top, bottom + 1):
            if top != bottom or left != right:
                left, right = _tile_columns(row, tile_y, tiles_x)
            for tile_x in range(left, right + 1):
                tile = tile_y * tiles_x + tile_x
                place = next_place[tile]
                next_place[tile] = place + 1
                pair_row[place] = i
                pair_slot[place] = slot
                slot += 1


@strict_kernel
def _sort(first, last, pair_row, pair_slot, depth_bits, scratch):
    """Sort the pairs first to last - 1, those of a tile, by depth: stable radix sort of bits.

    Reorders `pair_row` and `pair_slot` (P,). Reads `depth_bits` (N, ROW) int32, the bits of
    `rows`; `scratch` (6, L) int32 with L >= last - first is overwritten.
    """
    n = last - first
    keys, rows, slots = scratch[0], scratch[1], scratch[2]
    low = depth_bits[pair_row[first], DEPTH]
    high, last_bits, sorted_ = low, low, True
    for k in range(n):
        bits = depth_bits[pair_row[first + k], DEPTH]
        sorted_ &= bits >= last_bits
        last_bits = bits
        low, high = min(low, bits), max(high, bits)
        keys[k] = bits
    if sorted_:
        return
    for k in range(n):
        keys[k] -= low
        rows[k], slots[k] = pair_row[first + k], pair_slot[first + k]
    other_keys, order, other_order = scratch[3], scratch[4], scratch[5]
    for k in range(n):
        order[k] = k
    counts = np.empty(1 << _SORT_BITS, np.int32)
    mask = (1 << _SORT_BITS) - 1
    shift, span = 0, high - low
    while span >> shift > 0:
        counts[:] = 0
        for k in range(n):
            counts[(keys[k] >> shift) & mask] += 1
        place = 0
        for digit in range(len(counts)):
            count = counts[digit]
            counts[digit] = place
            place += count
        for k in range(n):
            digit = (keys[k] >> shift) & mask
            place = counts[digit]
            counts[digit] = place + 1
            other_keys[place], other_order[place] = keys[k], order[k]
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
        shift += _SORT_BITS
    for k in range(n):
        pair_row[first + k] = rows[order[k]]
        pair_slot[first + k] = slots[order[k]]


@strict_inlined
def _block_bounds(row, left, top):
    """Return the first and last column and row of a tile's blocks that a Gaussian reaches.

    `row` (ROW,) float32; (left, top) is the tile's corner, pixels. The pixels are those whose
    centre is within reach, ceil(low) to floor(high); casting rounds towards 0.
    """
    x, y = row[X] - left - _HALF, row[Y] - top - _HALF
    x0 = int(min(max(x - row[REACH_X] + _1, _0), _TILE))
    x1 = int(min(max(x + row[REACH_X] + _1, _0), _TILE)) - 1
    y0 = int(min(max(y - row[REACH_Y] + _1, _0), _TILE))
    y1 = int(min(max(y + row[REACH_Y] + _1, _0), _TILE)) - 1
    if x1 < x0 or y1 < y0:
        return 0, -1, 0, -1
    return x0 // BLOCK, x1 // BLOCK, y0 // BLOCK, y1 // BLOCK


@strict_kernel
def blend_tiles(
    piece, pieces, tiles_x, tile_starts, rows, depth_bits, pair_row, pair_slot, tile_ends, image
):
    """Sort and blend the Gaussians of each of the piece's tiles.

    Writes `image` (5, H, W) float32, as in `Rendering`, and `tile_ends` (T,): the first pair that
    was not blended. Sorts `pair_row` and `pair_slot` (P,) by tile. Reads `tile_starts` (T + 1,),
    `rows` (N, ROW) and `depth_bits`, the same memory as int32.
    """
    height, width = image.shape[1:]
    tile = _aligned(FORWARD_SIZE)
    longest = 0
    for t in range(piece, len(tile_ends), pieces):
        longest = max(longest, tile_starts[t + 1] - tile_starts[t])
    scratch = np.empty((6, longest), np.int32)
    for t in range(piece, len(tile_ends), pieces):
        first, last = tile_starts[t], tile_starts[t + 1]
        if last > first:
            _sort(first, last, pair_row, pair_slot, depth_bits, scratch)
        for block in range(BLOCKS * BLOCKS):
            for lane in range(LANES):
                tile[block * FORWARD * LANES + lane] = _1
            for k in range(LANES, FORWARD * LANES):
                tile[block * FORWARD * LANES + k] = _0
        left, top = t % tiles_x * TILE, t // tiles_x * TILE
        corner_x, corner_y = np.float32(left), np.float32(top)
        k = first
        while k < last:
            row = rows[pair_row[k]]
            x0, x1, y0, y1 = _block_bounds(row, corner_x, corner_y)
            blend(tile, row, x0, x1, y0, y1, corner_x, corner_y)
            k += 1
            if (k - first) % 32 == 0 and all_ended(tile):
                break
        tile_ends[t] = k
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                block = y // BLOCK * BLOCKS + x // BLOCK
                at = block * FORWARD * LANES + y % BLOCK * BLOCK + x % BLOCK
                image[4, top + y, left + x] = abs(tile[at])
                for plane in range(4):
                    image[plane, top + y, left + x] = tile[at + (plane + 1) * LANES]


@strict_kernel
def blend_tiles_backward(
    piece, pieces, tiles_x, tile_starts, tile_ends, rows, pair_row, pair_slot, image, gradient,
    out,
):  # fmt: skip
    """Sum the derivatives over the pixels of each of the piece's tiles.

    Writes `out` (P, ROW) float32, one row for each pair, 0 for pairs behind the end of the tile.
    Reads `tile_starts`, `tile_ends`, `rows`, `pair_row`, `pair_slot`, and `image` and `gradient`
    (5, H, W) float32.
    """
    height, width = image.shape[1:]
    tile = _aligned(BACKWARD_SIZE)
    for t in range(piece, len(tile_ends), pieces):
        first, last = tile_starts[t], tile_starts[t + 1]
        if first == last:
            continue
        left, top = t % tiles_x * TILE, t // tiles_x * TILE
        corner_x, corner_y = np.float32(left), np.float32(top)
        tile[:] = _0
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                block = y // BLOCK * BLOCKS + x // BLOCK
                at = block * BACKWARD * LANES + y % BLOCK * BLOCK + x % BLOCK
                total = _0
                for plane in range(5):
                    g = gradient[plane, top + y, left + x]
                    total += g * image[plane, top + y, left + x]
                    if plane < 4:
                        tile[at + (plane + 2) * LANES] = g
                tile[at] = _1
                tile[at + LANES] = total
        for k in range(first, tile_ends[t]):
            row = rows[pair_row[k]]
            x0, x1, y0, y1 = _block_bounds(row, corner_x, corner_y)
            blend_backward(tile, row, x0, x1, y0, y1, corner_x, corner_y, out, pair_slot[k])
        for k in range(tile_ends[t], last):
            out[pair_slot[k]] = _0


@strict_kernel
def chain_all(
    piece, pieces, planes, camera, tile_counts, first_slots, pair_sums, gradients, touched,
    weights, pose,
):  # fmt: skip
    """Add up the pairs of each of the piece's Gaussians, and apply the chain rule.

    Writes `gradients` (14, N) float32 by the parameters, `touched` (N,) bool, `weights` (N,)
    float32 blending weights summed over pixels, and row `piece` of `pose` (pieces, 6) float64 by
    xi. Reads `planes`, `camera`, `tile_counts`, `first_slots` and `pair_sums` (P, ROW).
    """
    first, last = _range(piece, pieces, planes.shape[1])
    summed, active = _aligned(SUMS * LANES), _aligned(LANES)
    out = _aligned(GRADIENTS * LANES)
    pose[piece] = 0.0
    for start in range(first, last, LANES):
        any_ = False
        for lane in range(LANES):
            i = start + lane
            for k in range(SUMS):
                summed[k * LANES + lane] = _0
            for slot in range(first_slots[i], first_slots[i] + tile_counts[i]):
                for k in range(SUMS):
                    summed[k * LANES + lane] += pair_sums[slot, k]
            weights[i] = summed[(SUMS - 1) * LANES + lane]
            touched[i] = weights[i] > 0
            active[lane] = np.float32(touched[i])
            any_ |= touched[i]
        if not any_:
            continue
        chain(planes, planes.shape[1], start, camera, summed, active, out)
        for lane in range(LANES):
            finite = _0
            for k in range(GRADIENTS):
                finite += _0 * out[k * LANES + lane]
            if touched[start + lane] and finite != finite:  # NaN, or 0 times infinity
                touched[start + lane] = False
            elif touched[start + lane]:
                for k in range(6):
                    pose[piece, k] += out[(_PARAMETERS + k) * LANES + lane]
        for k in range(_PARAMETERS):
            for lane in range(LANES):
                gradients[k, start + lane] = out[k * LANES + lane]
