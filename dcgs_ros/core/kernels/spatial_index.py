# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Nearest neighbours in a changing set of points: a hash of voxels, each with a list of points.

The kernels share these arrays: `keys` (C,) int64 packed cell coordinates, or -1 in an empty place;
`heads` (C,) int32 the first slot of each cell's list, or -1; `chain` (M,) int32 the next slot in
the list, or -1; `points` (M, 3) float32 metres, by slot. C is a power of two.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from .jit import CHUNKS, inlined, kernel, parallel_kernel

_EMPTY = -1
_MAX_LOAD = 0.5
_OFFSET = 1 << 20  # cell coordinates are packed into 21 bits each


class VoxelIndex:
    """Finds points by their position; a point is named by its slot, its row in an array.

    A query of radius r is exact for any r, and fastest for cells of 2 r. Of equally near points
    the lower slot wins, so that results do not depend on the order of insertion.
    """

    def __init__(self, cell_m: float) -> None:
        """Start empty, with cells of `cell_m` metres a side."""
        self._inverse_cell = 1.0 / cell_m
        self._keys = np.full(1 << 12, _EMPTY, np.int64)
        self._heads = np.full(1 << 12, _EMPTY, np.int32)
        self._next = np.full(1 << 12, _EMPTY, np.int32)
        self._cells = 0

    def insert(self, points: NDArray[np.float32], slots: NDArray[np.int32]) -> None:
        """Add the points `points[slots]`: (M, 3) metres and (N,) rows of it."""
        if not len(slots):
            return
        if slots.max() >= len(self._next):
            grown = np.full(2 * int(slots.max()) + 1, _EMPTY, np.int32)
            grown[: len(self._next)] = self._next
            self._next = grown
        if self._cells + len(slots) > _MAX_LOAD * len(self._keys):
            self._rehash(len(slots))
        self._cells += _insert(
            self._keys, self._heads, self._next, points, slots, self._inverse_cell
        )

    def remove(self, points: NDArray[np.float32], slots: NDArray[np.int32]) -> None:
        """Remove `slots` (N,); `points` (M, 3) must still hold what they were inserted with."""
        _remove(self._keys, self._heads, self._next, points, slots, self._inverse_cell)

    def _rehash(self, room: int) -> None:
        """Drop the cells that have become empty, and make room for `room` new ones."""
        live = int(np.count_nonzero(self._heads != _EMPTY))
        size = 1 << 12
        while live + room > 0.5 * _MAX_LOAD * size:  # at most half full: rehashing stays rare
            size *= 2
        keys = np.full(size, _EMPTY, np.int64)
        heads = np.full(size, _EMPTY, np.int32)
        self._cells = _move_cells(self._keys, self._heads, keys, heads)
        self._keys, self._heads = keys, heads

    def nearest(
        self,
        points: NDArray[np.float32],  # (M, 3) metres
        queries: NDArray[np.float32],  # (N, 3) metres
        radius_m: float,
    ) -> NDArray[np.int32]:
        """Return (N,) the slot of the nearest point within the radius of each query, or -1."""
        slots = np.full(len(queries), _EMPTY, np.int32)
        self.nearest_moved(points, queries, np.eye(4), radius_m, slots)
        return slots

    def nearest_moved(
        self,
        points: NDArray[np.float32],  # (M, 3) metres
        queries: NDArray[np.float32],  # (N, 3) metres
        T: NDArray[np.float64],  # (4, 4) from the queries' frame to the points'
        radius_m: float,
        slots: NDArray[np.int32],  # (N,) in: first candidates, or -1; out: the result
    ) -> None:
        """Write what `nearest` returns for the queries moved by T into `slots`.

        The result at a nearby pose is a good first candidate: it shortens the search.
        """
        _nearest(
            queries, T, radius_m, self._keys, self._heads, self._next, points,
            self._inverse_cell, slots,
        )  # fmt: skip

    def covered(
        self,
        points: NDArray[np.float32],  # (M, 3) metres
        queries: NDArray[np.float32],  # (N, 3) metres
        rays: NDArray[np.float32],  # (N, 3) unit
        across_m: NDArray[np.float32],  # (N,) radius of the cylinder
        along_m: NDArray[np.float32],  # (N,) half of its length
    ) -> NDArray[np.bool_]:
        """Return (N,) whether a point lies in the cylinder about each query, along its ray."""
        out = np.empty(len(queries), np.bool_)
        _covered(
            queries, rays, across_m, along_m, self._keys, self._heads, self._next, points,
            self._inverse_cell, out,
        )  # fmt: skip
        return out


@inlined
def _cell(x, inverse_cell):
    """Return the cell coordinate of x, metres, along one axis; `inverse_cell` in 1/metre."""
    return int(math.floor(x * inverse_cell))


@inlined
def _key(ix, iy, iz):
    """Return three cell coordinates packed into one int64."""
    return ((ix + _OFFSET) << 42) | ((iy + _OFFSET) << 21) | (iz + _OFFSET)


@inlined
def _key_at(x, y, z, inverse_cell):
    """Return the key of the cell that contains a point, metres."""
    return _key(_cell(x, inverse_cell), _cell(y, inverse_cell), _cell(z, inverse_cell))


@inlined
def _find(keys, key):
    """Return the place of `key` in `keys` (C,), or the empty place where it belongs."""
    mask = keys.shape[0] - 1
    mixed = np.uint64(key)
    mixed ^= mixed >> np.uint64(33)
    mixed *= np.uint64(0xFF51AFD7ED558CCD)
    mixed ^= mixed >> np.uint64(29)
    place = np.int64(mixed & np.uint64(mask))
    while keys[place] != _EMPTY and keys[place] != key:
        place = (place + 1) & mask
    return place


@kernel
def _insert(keys, heads, chain, points, slots, inverse_cell):
    """Put `slots` (N,) at the heads of their cells' lists; return the number of new cells.

    Writes `keys` (C,), `heads` (C,) and `chain` (M,); reads `points` (M, 3) metres.
    """
    created = 0
    for slot in slots:
        key = _key_at(points[slot, 0], points[slot, 1], points[slot, 2], inverse_cell)
        place = _find(keys, key)
        if keys[place] == _EMPTY:
            keys[place] = key
            created += 1
        chain[slot] = heads[place]
        heads[place] = slot
    return created


@kernel
def _remove(keys, heads, chain, points, slots, inverse_cell):
    """Take `slots` (N,) out of their cells' lists.

    Writes `heads` (C,) and `chain` (M,); reads `keys` (C,) and `points` (M, 3) metres.
    """
    for slot in slots:
        key = _key_at(points[slot, 0], points[slot, 1], points[slot, 2], inverse_cell)
        place = _find(keys, key)
        at = heads[place]
        if at == slot:
            heads[place] = chain[slot]
            continue
        while at != _EMPTY:
            if chain[at] == slot:
                chain[at] = chain[slot]
                break
            at = chain[at]


@kernel
def _move_cells(keys, heads, new_keys, new_heads):
    """Copy the cells that hold points to another table; return their number.

    Reads `keys`, `heads` (C,); writes `new_keys`, `new_heads` (C',), which start out empty.
    """
    count = 0
    for old in range(keys.shape[0]):
        if heads[old] == _EMPTY:
            continue
        place = _find(new_keys, keys[old])
        new_keys[place] = keys[old]
        new_heads[place] = heads[old]
        count += 1
    return count


@inlined
def _gap(x, i, cell):
    """Return the distance, metres, along one axis from x to the interval of cell i."""
    return max(0.0, max(i * cell - x, x - (i + 1) * cell))


@inlined
def _closest_in(place, x, y, z, best, best_slot, heads, chain, points):
    """Return the least squared distance to (x, y, z), square metres, and its slot.

    Starts from `best` and `best_slot` and looks through the list of the cell at `place`; reads
    `heads` (C,), `chain` (M,) and `points` (M, 3) metres.
    """
    slot = heads[place]
    while slot != _EMPTY:
        dx, dy, dz = points[slot, 0] - x, points[slot, 1] - y, points[slot, 2] - z
        d = dx * dx + dy * dy + dz * dz
        if d < best or (d == best and (best_slot < 0 or slot < best_slot)):
            best, best_slot = d, slot
        slot = chain[slot]
    return best, best_slot


@parallel_kernel
def _nearest(queries, T, radius, keys, heads, chain, points, inverse_cell, slots):
    """Write into `slots` (N,) the nearest point of each query, or -1; it holds first candidates.

    `queries` (N, 3) metres are moved by `T` (4, 4); `radius` in metres. Reads `keys`, `heads`
    (C,), `chain` (M,) and `points` (M, 3) metres.
    """
    n = queries.shape[0]
    cell = 1.0 / inverse_cell
    for chunk in prange(CHUNKS):
        for i in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            qx, qy, qz = queries[i, 0], queries[i, 1], queries[i, 2]
            x = T[0, 0] * qx + T[0, 1] * qy + T[0, 2] * qz + T[0, 3]
            y = T[1, 0] * qx + T[1, 1] * qy + T[1, 2] * qz + T[1, 3]
            z = T[2, 0] * qx + T[2, 1] * qy + T[2, 2] * qz + T[2, 3]
            best, best_slot = radius * radius, -1
            if slots[i] >= 0:
                slot = slots[i]
                dx, dy, dz = points[slot, 0] - x, points[slot, 1] - y, points[slot, 2] - z
                d = dx * dx + dy * dy + dz * dz
                if d < best:
                    best, best_slot = d, slot
            # The query's own cell first: a near point there leaves few other cells to search.
            own = _key_at(x, y, z, inverse_cell)
            place = _find(keys, own)
            if keys[place] != _EMPTY:
                best, best_slot = _closest_in(
                    place, x, y, z, best, best_slot, heads, chain, points
                )
            reach = math.sqrt(best)
            for ix in range(_cell(x - reach, inverse_cell), _cell(x + reach, inverse_cell) + 1):
                gap_x = _gap(x, ix, cell)
                for iy in range(
                    _cell(y - reach, inverse_cell), _cell(y + reach, inverse_cell) + 1
                ):
                    gap_y = _gap(y, iy, cell)
                    gap_xy = gap_x * gap_x + gap_y * gap_y
                    if gap_xy > best:
                        continue
                    for iz in range(
                        _cell(z - reach, inverse_cell), _cell(z + reach, inverse_cell) + 1
                    ):
                        gap_z = _gap(z, iz, cell)
                        key = _key(ix, iy, iz)
                        if gap_xy + gap_z * gap_z > best or key == own:
                            continue
                        place = _find(keys, key)
                        if keys[place] != _EMPTY:
                            best, best_slot = _closest_in(
                                place, x, y, z, best, best_slot, heads, chain, points
                            )
            slots[i] = best_slot


@parallel_kernel
def _covered(queries, rays, across, along, keys, heads, chain, points, inverse_cell, out):
    """Write into `out` (N,) bool whether a point is in the cylinder about each query.

    `queries` (N, 3) metres, `rays` (N, 3) unit, `across` and `along` (N,) metres. Reads `keys`,
    `heads` (C,), `chain` (M,) and `points` (M, 3) metres.
    """
    n = queries.shape[0]
    for chunk in prange(CHUNKS):
        for i in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
            across2 = across[i] * across[i]
            reach = math.sqrt(across2 + along[i] * along[i])
            found = False
            for ix in range(_cell(x - reach, inverse_cell), _cell(x + reach, inverse_cell) + 1):
                for iy in range(
                    _cell(y - reach, inverse_cell), _cell(y + reach, inverse_cell) + 1
                ):
                    for iz in range(
                        _cell(z - reach, inverse_cell), _cell(z + reach, inverse_cell) + 1
                    ):
                        if found:
                            continue
                        place = _find(keys, _key(ix, iy, iz))
                        if keys[place] == _EMPTY:
                            continue
                        slot = heads[place]
                        while slot != _EMPTY and not found:
                            dx, dy, dz = (
                                points[slot, 0] - x,
                                points[slot, 1] - y,
                                points[slot, 2] - z,
                            )
                            axial = dx * rays[i, 0] + dy * rays[i, 1] + dz * rays[i, 2]
                            square = dx * dx + dy * dy + dz * dz
                            found = abs(axial) <= along[i] and square - axial * axial <= across2
                            slot = chain[slot]
            out[i] = found
