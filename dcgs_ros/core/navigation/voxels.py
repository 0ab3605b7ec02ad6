# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Columns of voxels, and what rays through them and ends in them make of their evidence."""

from __future__ import annotations

import math

import numpy as np

from ..kernels.jit import fast_kernel

UNSEEN = -128  # evidence of a voxel that no ray has met
FREE, OCCUPIED, UNKNOWN = 0, 100, -1  # of a cell, as nav_msgs/OccupancyGrid has them
# Log odds in steps: a hit tells twice as much as a pass (rays graze what they do not hit), and the
# limits let six passes clear whatever was there, however long.
_HIT, _PASS, _MOST, _LEAST = 2, 1, 6, -6
_PASSED, _ENDED = 1, 2  # marks of one scan


@fast_kernel
def add_rays(columns, corner, camera, ends, hits, clear, floor_m, layer_m, cell_m):
    """Add a scan to the evidence; return the range of cells (4,) x0 x1 y0 y1 that it may change.

    Writes `columns` (H, W, L) int8: evidence of each layer above `floor_m`. `corner` (2,) int64 is
    the index of the first cell, `camera` (3,) and `ends` (N, 3) are in the map, metres, `hits`
    (N,) bool: whether a ray ends on a surface. `clear` (N,) is the share of each ray that is
    surely free. What a ray of the scan ends in stops others: they may be wrong, or graze it.
    """
    height, width, depth = columns.shape
    bounds = _bounds(corner, camera, ends, cell_m, height, width)
    x0, x1, y0, y1 = bounds
    if x0 >= x1 or y0 >= y1:
        return bounds
    marks = np.zeros((y1 - y0, x1 - x0, depth), np.uint8)
    shift_x, shift_y = corner[0] + x0, corner[1] + y0
    for i in range(ends.shape[0]):
        x = int(math.floor(ends[i, 0] / cell_m)) - shift_x
        y = int(math.floor(ends[i, 1] / cell_m)) - shift_y
        layer = int(math.floor((ends[i, 2] - floor_m) / layer_m))
        if hits[i] and 0 <= layer < depth and 0 <= x < x1 - x0 and 0 <= y < y1 - y0:
            marks[y, x, layer] = _ENDED
    for i in range(ends.shape[0]):
        _pass(marks, shift_x, shift_y, camera, ends[i], clear[i], floor_m, layer_m, cell_m)
    for y in range(y1 - y0):
        for x in range(x1 - x0):
            for k in range(depth):
                mark = marks[y, x, k]
                if mark == 0:
                    continue
                value = columns[y0 + y, x0 + x, k]
                value = 0 if value == UNSEEN else value
                value += _HIT if mark == _ENDED else -_PASS
                columns[y0 + y, x0 + x, k] = min(max(value, _LEAST), _MOST)
    return bounds


@fast_kernel
def _bounds(corner, camera, ends, cell_m, height, width):
    """Return the range of cells x0, x1, y0, y1 that rays cross, within the grid."""
    bounds = np.empty(4, np.int64)
    for k in range(2):
        least, greatest = camera[k], camera[k]
        for i in range(ends.shape[0]):
            least, greatest = min(least, ends[i, k]), max(greatest, ends[i, k])
        size = width if k == 0 else height
        first = int(math.floor(least / cell_m)) - corner[k]
        last = int(math.floor(greatest / cell_m)) - corner[k]
        bounds[2 * k] = min(max(first, 0), size)
        bounds[2 * k + 1] = min(max(last + 1, 0), size)
    return bounds


@fast_kernel
def _pass(marks, shift_x, shift_y, camera, end, clear, floor_m, layer_m, cell_m):
    """Mark the voxels that a ray passes, cell by cell (Amanatides and Woo 1987)."""
    rows, cols, depth = marks.shape
    dx, dy, dz = end[0] - camera[0], end[1] - camera[1], end[2] - camera[2]
    px, py = camera[0] / cell_m - shift_x, camera[1] / cell_m - shift_y
    x, y = int(math.floor(px)), int(math.floor(py))
    step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    per_x = cell_m / abs(dx) if dx != 0.0 else np.inf
    per_y = cell_m / abs(dy) if dy != 0.0 else np.inf
    next_x = (x + (step_x > 0) - px) * step_x * per_x if dx != 0.0 else np.inf
    next_y = (y + (step_y > 0) - py) * step_y * per_y if dy != 0.0 else np.inf
    share = 0.0
    while share < clear:
        until = min(next_x, next_y, clear)
        low, high = camera[2] + share * dz, camera[2] + until * dz
        if low > high:
            low, high = high, low
        first = int(math.floor((low - floor_m) / layer_m))
        last = int(math.floor((high - floor_m) / layer_m))
        if 0 <= x < cols and 0 <= y < rows:
            for k in range(max(first, 0), min(last + 1, depth)):
                if marks[y, x, k] == _ENDED:
                    return
                marks[y, x, k] = _PASSED
        share = until
        if next_x < next_y:
            next_x += per_x
            x += step_x
        else:
            next_y += per_y
            y += step_y


@fast_kernel
def project(columns, cells, bounds, low):
    """Write what the columns tell into `cells` (H, W) int8; return the range that changed (4,).

    Occupied: some layer is. Free: all of the lowest `low` layers were seen to be empty. `bounds`
    (4,) x0 x1 y0 y1 are the cells to look at; without a change x0 = x1.
    """
    x0, x1, y0, y1 = bounds
    changed = np.array([x1, x0, y1, y0])
    for y in range(y0, y1):
        for x in range(x0, x1):
            empty, most = 0, UNSEEN
            for k in range(columns.shape[2]):
                evidence = columns[y, x, k]
                most = max(most, evidence)
                empty += k < low and UNSEEN < evidence <= 0
            value = OCCUPIED if most >= _HIT else FREE if empty == low else UNKNOWN
            if cells[y, x] != value:
                cells[y, x] = value
                changed[0], changed[1] = min(changed[0], x), max(changed[1], x + 1)
                changed[2], changed[3] = min(changed[2], y), max(changed[3], y + 1)
    if changed[0] >= changed[1]:
        changed[:] = 0
    return changed
