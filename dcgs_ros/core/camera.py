# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Pinhole camera with Brown-Conrady distortion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .errors import DcgsError
from .kernels import lens

LARGEST = 1e6  # number of a camera: squares and powers of larger ones overflow
_GRID = 9  # pixels a side of the image for which a lens is checked
_RETURNS_PX = 0.1  # a pixel that comes back farther away is not where the lens put it


class CameraError(DcgsError):
    """The intrinsics do not describe a usable camera."""


class LensError(CameraError):
    """The distortion cannot be undone over the image."""


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of the colour image, to which depth is registered.

    Pixel centres lie on integers (OpenCV's convention): the first pixel is (0, 0). `distortion` is
    OpenCV's (k1, k2, p1, p2[, k3[, k4, k5, k6]]); empty means none.
    """

    width: int
    height: int
    fx: float  # pixels
    fy: float  # pixels
    cx: float  # pixels
    cy: float  # pixels
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check the values, which would otherwise fail later, inside a kernel."""
        if self.width < 16 or self.height < 16:
            raise CameraError(f'image of {self.width}x{self.height} pixels is smaller than 16x16')
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not (np.all(np.abs(numbers) <= LARGEST) and min(self.fx, self.fy) > 1e-3):
            raise CameraError(f'intrinsics fx fy cx cy distortion = {numbers} are not usable')
        if len(self.distortion) not in (0, 4, 5, 8):
            raise CameraError(f'distortion has {len(self.distortion)} numbers, not 0, 4, 5 or 8')
        if any(self.distortion):
            self._check_lens()

    def _check_lens(self) -> None:
        """Check that pixels come back to where they were, undistorted and distorted again."""
        u, v = np.linspace(0, self.width - 1, _GRID), np.linspace(0, self.height - 1, _GRID)
        pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        errors = lens.inversion_errors(self.parameters, pixels)
        worst = int(errors.argmax())
        if not errors[worst] < _RETURNS_PX:
            raise LensError(
                f'the lens model cannot be inverted over the image: pixel {pixels[worst]} of '
                f'{self.width}x{self.height} comes back {errors[worst]:.3g} px away (distortion '
                f'{self.distortion}); calibrate again, or rectify the images'
            )

    @property
    def focal(self) -> float:
        """Mean focal length in pixels: the f of the paper's sigma_perp = z s / f."""
        return 0.5 * (self.fx + self.fy)

    @cached_property
    def parameters(self) -> NDArray[np.float64]:
        """(12,) fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6: the form the kernels take."""
        padded = np.zeros(12)
        padded[:4] = self.fx, self.fy, self.cx, self.cy
        padded[4 : 4 + len(self.distortion)] = self.distortion
        return padded

    @cached_property
    def undistortion_map(self) -> NDArray[np.float32]:
        """(H, W, 2) undistorted x/z, y/z of the ray through each pixel.

        The tracker undistorts its measurements, not the images: nothing is resampled.
        """
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float32), np.arange(self.height))
        pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
        return self.undistort(pixels).reshape(self.height, self.width, 2)

    def undistort(self, pixels: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return undistorted normalised coordinates x/z, y/z (N, 2) of pixels (N, 2)."""
        return lens.undistort(self.parameters, np.asarray(pixels, np.float64))

    def project(self, points_cam: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return distorted pixels (N, 2) of points (N, 3) in the camera frame, metres, z > 0."""
        return lens.project(self.parameters, np.asarray(points_cam, np.float64))
