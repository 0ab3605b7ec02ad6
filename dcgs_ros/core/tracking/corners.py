# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Detection of corners that stand out of the image's noise, spread over the image."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ..config.stages import LandmarkConfig
from ..kernels.jit import kernel

# OpenCV's minimal eigenvalue of a 3x3 block where the weakest gradient is 1 grey level per pixel:
# its Sobel operator has gain 8 and is divided by 4 * 3 * 255.
_EIGENVALUE = 9.0 * (8.0 / 3060.0) ** 2
# Its response to white noise has standard deviation 6 (Immerkaer 1996), to a linear ramp zero.
_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_LEAST_NOISE = 0.3  # grey levels: of rounding
_ROWS_APART = 4  # rows of the Laplacian of which the median is taken: some 20 000 pixels
_GRID = (6, 8)  # cells, down and across
_FEW = 0.3  # share of the wanted corners below which a coarser image is searched too


def corners(
    grey: NDArray[np.uint8],  # (H, W)
    taken: NDArray[np.float32],  # (L, 2)
    wanted: int,
    config: LandmarkConfig,
) -> NDArray[np.float32]:
    """Return Shi-Tomasi corners (N, 2) away from those `taken`, the best of each cell first.

    They are found at half resolution, and where those are few, at a quarter too: motion blur
    leaves only coarse texture. A corner is one where even the weakest gradient exceeds what the
    image's noise would make of it: in dim light low contrast is all there is, and on a wall
    without texture the strongest corners are noise.
    """
    found = np.empty((0, 2), np.float32)
    for scale in (2, 4):
        if len(found) < _FEW * wanted:
            more = _corners_at(grey, scale, np.concatenate([taken, found]), config)
            found = np.concatenate([found, more])
    return found[:wanted]


def _corners_at(
    grey: NDArray[np.uint8], scale: int, taken: NDArray[np.float32], config: LandmarkConfig
) -> NDArray[np.float32]:
    """Return the corners (N, 2) in the image made smaller by `scale`, pixels of the whole one."""
    share = 1.0 / scale
    small = cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    strength = cv2.cornerMinEigenVal(small, 3)
    weakest = config.min_gradient_sigmas * noise(small)
    reach = max(round(config.min_distance_px / scale), 1)
    _clear(strength, np.round(taken / scale).astype(np.int64), reach)
    around = np.ones((2 * reach + 1,) * 2, np.uint8)
    strength[:2] = strength[-2:] = strength[:, :2] = strength[:, -2:] = 0.0
    peaks = strength >= np.maximum(cv2.dilate(strength, around), weakest**2 * _EIGENVALUE)
    y, x = np.divmod(np.flatnonzero(peaks), small.shape[1])
    order = _by_cell(
        strength[y, x], y * _GRID[0] // small.shape[0], x * _GRID[1] // small.shape[1]
    )
    centre = 0.5 * (scale - 1)  # of the first small pixel
    return np.column_stack([x[order], y[order]]).astype(np.float32) * scale + np.float32(centre)


def noise(grey: NDArray[np.uint8]) -> float:
    """Return the standard deviation of an image's noise (H, W), grey levels.

    It is the median of the Laplacian of a Laplacian, which little of a scene's structure survives.
    """
    response = np.abs(cv2.filter2D(grey, cv2.CV_16S, _LAPLACIAN)[::_ROWS_APART]).ravel()
    below = np.cumsum(np.bincount(response))  # whole numbers, each of which stands for +-0.5
    median = float(np.interp(0.5 * below[-1], below, np.arange(len(below)) + 0.5))
    return max(1.4826 * median / 6.0, _LEAST_NOISE)


def spread(pixels: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return how many of the pixels (N, 2) are in each cell of an image of `shape` (H, W)."""
    cells = np.floor(pixels[:, ::-1] * np.array(_GRID) / np.array(shape)).astype(np.int64)
    cells = np.clip(cells, 0, np.array(_GRID) - 1)
    return np.bincount(cells[:, 0] * _GRID[1] + cells[:, 1], minlength=_GRID[0] * _GRID[1])


def _by_cell(
    strength: NDArray[np.float32], row: NDArray[np.int64], column: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the order (N,): the strongest of each cell, then the second of each, and so on."""
    cell = row * _GRID[1] + column
    order = np.lexsort((-strength, cell))
    first = np.searchsorted(cell[order], cell[order])  # where each one's cell begins
    rank = np.arange(len(order)) - first
    return order[np.lexsort((-strength[order], rank))]


@kernel
def _clear(image, centres, radius):
    """Write 0 into the discs of `image` (H, W) about `centres` (N, 2) x, y; `radius` in pixels."""
    height, width = image.shape
    for n in range(centres.shape[0]):
        x, y = centres[n, 0], centres[n, 1]
        for v in range(max(y - radius, 0), min(y + radius + 1, height)):
            half = int(math.sqrt(radius * radius - (v - y) * (v - y)))
            for u in range(max(x - half, 0), min(x + half + 1, width)):
                image[v, u] = 0.0
