# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Gaussian noise images from a counter-based generator: the same with any number of threads."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from scipy.special import ndtri

_BITS = 12  # per sample: five samples a hash, at most 3.7 sigma
_QUANTILES = ndtri((np.arange(1 << _BITS) + 0.5) / (1 << _BITS)).astype(np.float32)
_QUANTILES /= _QUANTILES.std()


def white_noise(
    seed: int, index: int, stream: int, shape: tuple[int, int, int]
) -> NDArray[np.float32]:
    """Return independent standard normal planes (C <= 5, H, W) of one stream of one frame."""
    key = np.random.SeedSequence((seed, index, stream)).generate_state(1, np.uint64)[0]
    planes = np.empty(shape, np.float32)
    _fill(key, _QUANTILES, planes)
    return planes


def smoothed(plane: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """Return a white plane (H, W), blurred and scaled back to unit variance."""
    size = 2 * round(3 * sigma_px) + 1
    # Independent samples under weights k k^T have the variance (sum k^2)^2.
    deviation = float(np.square(cv2.getGaussianKernel(size, sigma_px)).sum())
    return cv2.GaussianBlur(plane, (size, size), sigma_px) / np.float32(deviation)


@njit(cache=True, nogil=True, parallel=True)
def _fill(key, quantiles, planes):
    """Fill `planes` (C, H, W) float32 from SplitMix64 of the pixel's number.

    Each plane takes other bits of the hash, which select from `quantiles` (2 ** _BITS,) float32.
    """
    count, height, width = planes.shape
    mask = np.uint64(quantiles.shape[0] - 1)
    for y in prange(height):
        for x in range(width):
            h = key + np.uint64(y * width + x + 1) * np.uint64(0x9E3779B97F4A7C15)
            h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            h = h ^ (h >> np.uint64(31))
            for c in range(count):
                planes[c, y, x] = quantiles[np.int64(h & mask)]
                h = h >> np.uint64(_BITS)
