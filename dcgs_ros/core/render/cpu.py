# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The renderer for CPUs: tiles, explicit SIMD, analytic backward pass."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..kernels.workers import PIECES, Workers
from ..mapping.splats import PLANES
from . import tiles
from .blending import ROW, TILE
from .projection import camera_numbers
from .renderer import Gradients, RenderError, Rendering, View
from .simd import LANES

_MAX_PAIRS = 40_000_000  # of Gaussian and tile: 64 bytes each in the backward pass
_TRANSPARENT = -100.0  # logit

Scalar = TypeVar('Scalar', bound=np.generic)


class CpuRenderer:
    """A `Renderer` on CPU threads; its result does not depend on their number."""

    def __init__(self, workers: Workers) -> None:
        """Use the threads of `workers`; buffers grow as needed."""
        self._workers = workers
        self._gaussians = _Buffers()
        self._pairs = _Buffers()
        self._images = _Buffers()
        self._image: NDArray[np.float32] | None = None

    def render(self, planes: NDArray[np.float32], view: View) -> Rendering:
        """Return an image of the Gaussians of `planes` (14, N); see `Renderer`."""
        self._image = None  # if this fails, `backward` has nothing to derive
        if planes.ndim != 2 or len(planes) != len(PLANES) or planes.dtype != np.float32:
            raise RenderError(f'planes are {planes.dtype} {planes.shape}, not float32 (14, N)')
        self._count = planes.shape[1]
        self._planes = _padded(planes)
        self._camera = camera_numbers(view)
        self._tiles_x, tiles_y = -(-view.width // TILE), -(-view.height // TILE)
        n, tiles_count = self._planes.shape[1], self._tiles_x * tiles_y
        g = self._gaussians
        self._rows = g.get('rows', (n, ROW), np.float32)
        self._tile_counts = g.get('tile_counts', (n,), np.int32)
        self._first_slots = g.get('first_slots', (n,), np.int64)
        histogram = g.get('histogram', (PIECES, tiles_count), np.int64)
        self._tile_starts = g.get('tile_starts', (tiles_count + 1,), np.int64)
        run = self._workers.run
        run(
            tiles.project_all, self._planes, self._camera, self._tiles_x, tiles_y, self._rows,
            self._tile_counts, histogram,
        )  # fmt: skip
        pairs = tiles.lay_out(self._tile_counts, histogram, self._first_slots, self._tile_starts)
        if pairs > _MAX_PAIRS:
            raise RenderError(
                f'{self._count} Gaussians cover {pairs} tiles of {view.width}x{view.height} '
                f'pixels, more than {_MAX_PAIRS}: they are too large'
            )
        self._pair_row = self._pairs.get('row', (pairs,), np.int32)
        self._pair_slot = self._pairs.get('slot', (pairs,), np.int32)
        run(
            tiles.scatter, self._tiles_x, tiles_y, self._rows, self._tile_counts,
            self._first_slots, histogram, self._pair_row, self._pair_slot,
        )  # fmt: skip
        self._tile_ends = g.get('tile_ends', (tiles_count,), np.int64)
        self._image = self._images.get('image', (5, view.height, view.width), np.float32)
        run(
            tiles.blend_tiles, self._tiles_x, self._tile_starts, self._rows,
            self._rows.view(np.int32), self._pair_row, self._pair_slot, self._tile_ends,
            self._image,
        )  # fmt: skip
        return Rendering(self._image)

    def backward(self, gradient: NDArray[np.float32]) -> Gradients:
        """Return the derivatives, given dL / d planes (5, H, W) of the last rendering."""
        if self._image is None:
            raise RenderError('nothing to derive: call render first')
        if gradient.shape != self._image.shape or gradient.dtype != np.float32:
            raise RenderError(
                f'gradient is {gradient.dtype} {gradient.shape}, not float32 {self._image.shape}'
            )
        sums = self._pairs.get('sums', (len(self._pair_row), ROW), np.float32)
        run = self._workers.run
        run(
            tiles.blend_tiles_backward, self._tiles_x, self._tile_starts, self._tile_ends,
            self._rows, self._pair_row, self._pair_slot, self._image, gradient, sums,
        )  # fmt: skip
        n, g = self._planes.shape[1], self._gaussians
        gradients = g.get('gradients', (len(PLANES), n), np.float32)
        touched = g.get('touched', (n,), np.bool_)
        weights = g.get('weights', (n,), np.float32)
        pose = g.get('pose', (PIECES, 6), np.float64)
        run(
            tiles.chain_all, self._planes, self._camera, self._tile_counts, self._first_slots,
            sums, gradients, touched, weights, pose,
        )  # fmt: skip
        kept = slice(self._count)
        return Gradients(gradients[:, kept], touched[kept], pose.sum(axis=0), weights[kept])


def _padded(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return planes (14, M), filled up to whole groups of LANES with transparent Gaussians."""
    missing = -planes.shape[1] % LANES
    if not missing and planes.flags.c_contiguous:
        return planes
    padded = np.full((len(planes), planes.shape[1] + missing), _TRANSPARENT, np.float32)
    padded[:, : planes.shape[1]] = planes
    return padded


class _Buffers:
    """Arrays that are reallocated only if they are too small; they start on a cache line."""

    def __init__(self) -> None:
        self._memory: dict[str, NDArray[np.uint8]] = {}

    def get(self, name: str, shape: tuple[int, ...], dtype: type[Scalar]) -> NDArray[Scalar]:
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        memory = self._memory.get(name)
        if memory is None or len(memory) < size:
            raw = np.empty(size + size // 4 + 64, np.uint8)
            first = -raw.ctypes.data % 64
            self._memory[name] = memory = raw[first:]
        return memory[:size].view(dtype).reshape(shape)
