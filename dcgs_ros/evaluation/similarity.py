# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""PSNR and SSIM of two images, over all or over the valid pixels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import DcgsError

Image = NDArray[np.floating]  # (H, W, 3)

PSNR_MAX_DB = 100.0  # instead of infinity, for images that are (nearly) equal
_C1, _C2 = 0.01**2, 0.03**2
_WINDOW_PX, _SIGMA_PX = (11, 11), 1.5


class SimilarityError(DcgsError):
    """Two images cannot be compared."""


def psnr_db(image: Image, truth: Image, valid: NDArray[np.bool_] | None = None) -> float:
    """Return the peak signal-to-noise ratio of (H, W, 3) images in 0 to 1, at most `PSNR_MAX_DB`.

    The squared error is averaged over all channels of the pixels where `valid` (H, W) is true.
    Raises `SimilarityError` if shapes differ or no pixel is valid.
    """
    check_images(image, truth, valid)
    squared = np.square(np.subtract(image, truth, dtype=np.float64))
    error = float(squared.mean() if valid is None else squared[valid].mean())
    return -10.0 * float(np.log10(np.maximum(error, 10 ** (-PSNR_MAX_DB / 10))))


def ssim(image: Image, truth: Image, valid: NDArray[np.bool_] | None = None) -> float:
    """Return the structural similarity of (H, W, 3) images in 0 to 1 (Wang et al. 2004).

    Computed per channel in Gaussian windows of 11x11 pixels with sigma 1.5 and zeros beyond the
    border (as in 3DGS), and averaged over the pixels where `valid` (H, W) is true. Invalid pixels
    are taken from `truth` in both images. Raises `SimilarityError` if shapes differ or no pixel is
    valid.
    """
    check_images(image, truth, valid)
    # float32 changes the mean by less than 1e-6 and takes less than half the time of float64.
    x, y = image.astype(np.float32), truth.astype(np.float32)
    if valid is not None:
        x = np.where(valid[..., None], x, y)
    mean_x, mean_y = _blurred(x), _blurred(y)
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    covariance = _blurred(x * y) - product
    variances = _blurred(x * x + y * y) - squares
    similarity = (2 * product + _C1) * (2 * covariance + _C2)
    similarity /= (squares + _C1) * (variances + _C2)
    counted = similarity if valid is None else similarity[valid]
    return float(counted.mean(dtype=np.float64))


def check_images(image: Image, truth: Image, valid: NDArray[np.bool_] | None = None) -> None:
    """Raise `SimilarityError` unless both are (H, W, 3) and at least one pixel is valid."""
    if image.ndim != 3 or image.shape[2] != 3 or image.shape != truth.shape:
        raise SimilarityError(f'images of {image.shape} and {truth.shape}, not both (H, W, 3)')
    if valid is not None and (valid.shape != image.shape[:2] or valid.dtype != np.bool_):
        raise SimilarityError(
            f'valid is {valid.dtype} {valid.shape}, not bool {image.shape[:2]} as the images are'
        )
    pixels = image[..., 0].size
    if not (pixels if valid is None else valid.any()):
        raise SimilarityError(f'none of {pixels} pixels is valid')


def _blurred(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (H, W, 3) averaged in Gaussian windows."""
    return cv2.GaussianBlur(values, _WINDOW_PX, _SIGMA_PX, borderType=cv2.BORDER_CONSTANT)
