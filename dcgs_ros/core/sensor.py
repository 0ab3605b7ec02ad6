# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Noise of a depth camera: the axial noise model and the covariance S(v, z; s)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .config.schema import described
from .errors import DcgsError

_STAMP_MS = 10.0  # of cameras at USB; three sequences of TUM lie 8 to 13 ms beside their truth


class SensorError(DcgsError):
    """Noise parameters outside their range."""


@dataclass(frozen=True)
class SensorNoise:
    """Axial noise sigma_z(z) = A + B z^2 (paper, tracking covariance) and the usable range.

    The model is one of depth; as in the paper it is given the range |a|, which overestimates sigma
    in the image corners by at most 1 / cos^2 of half the field of view.
    """

    a_m: float = described(
        0.0012, 'A of the depth noise A + B z^2: standard deviation at distance zero, metres.'
    )
    b_per_m: float = described(
        0.0014, 'B of the depth noise A + B z^2: growth with the squared distance, 1/metre.'
    )
    depth_min_m: float = described(0.3, 'Smallest depth that is used, metres.')
    depth_max_m: float = described(5.0, 'Largest depth that is used, metres.')
    depth_bias: float = described(
        0.0,
        'Standard deviation of the smooth relative error of depth over the image, of a camera '
        'without a calibration; 0: none.',
    )
    depth_readout_ms: float = described(
        0.0,
        'Time from the exposure of the first row of a depth image to that of the last, '
        'milliseconds; 0: global shutter.',
    )
    color_readout_ms: float = described(
        0.0,
        'Time from the exposure of the first row of a colour image to that of the last, '
        'milliseconds; the stamp is that of the middle row.',
    )
    stamp_ms: float = described(
        0.0,
        'Standard deviation of the time between the exposure of a colour image and its stamp, '
        'milliseconds.',
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not (self.a_m > 0 and self.b_per_m >= 0):
            raise SensorError(f'need a_m > 0 and b_per_m >= 0, got {self.a_m} and {self.b_per_m}')
        if not 0 <= self.depth_min_m < self.depth_max_m:
            raise SensorError(
                f'need 0 <= depth_min_m < depth_max_m, got {self.depth_min_m} '
                f'and {self.depth_max_m}'
            )
        times = self.depth_readout_ms, self.color_readout_ms, self.stamp_ms
        if not 0 <= self.depth_bias < 0.5:
            raise SensorError(f'need 0 <= depth_bias < 0.5, got {self.depth_bias}')
        if not all(time >= 0 for time in times):
            raise SensorError(
                f'need depth_readout_ms, color_readout_ms and stamp_ms >= 0, got {times}'
            )

    @classmethod
    def structured_light(cls) -> SensorNoise:
        """Return Kinect v1's: a fit to Nguyen 2012's 0.0012 + 0.0019 (z - 0.4)^2 m, 0.4 to 3 m."""
        return cls()

    @classmethod
    def kinect(cls) -> SensorNoise:
        """Return a real Kinect v1's or Xtion's, whose depth no calibration has corrected.

        Both its imagers have rolling shutters. The readouts take nearly the whole frame interval
        (colour's: Ringaby and Forssen, ICCV 2011), and images are stamped on arrival.
        """
        readouts = {'depth_readout_ms': 30.0, 'color_readout_ms': 26.0}
        return replace(cls.structured_light(), depth_bias=0.01, **readouts, stamp_ms=_STAMP_MS)

    @classmethod
    def stereo(
        cls,
        depth_focal_px: float,
        baseline_m: float,
        subpixel_px: float = 0.08,
        depth_min_m: float = 0.25,
        depth_max_m: float = 6.0,
    ) -> SensorNoise:
        """Return the noise of active stereo: dz = z^2 / (f b) d(disparity).

        `depth_focal_px` is that of the DEPTH imager, also if depth is aligned to colour. Raises
        `SensorError` for values out of range.
        """
        if depth_focal_px <= 0 or baseline_m <= 0 or subpixel_px < 0:
            raise SensorError(
                f'need focal > 0 px, baseline > 0 m, subpixel >= 0 px, got {depth_focal_px}, '
                f'{baseline_m}, {subpixel_px}'
            )
        return cls(0.001, subpixel_px / (depth_focal_px * baseline_m), depth_min_m, depth_max_m)

    @classmethod
    def realsense(cls, depth_focal_px: float) -> SensorNoise:
        """Return a real D435's or D435i's: stereo with 50 mm between its imagers.

        Depth has a global shutter. Colour's rows are spread over nearly all of a frame interval at
        30 Hz (librealsense, issues 2724 and 3554).
        """
        noise = cls.stereo(depth_focal_px, 0.05)
        return replace(noise, color_readout_ms=30.0, stamp_ms=_STAMP_MS)

    @classmethod
    def floor(cls, sigma_m: float = 0.001, depth_max_m: float = 12.0) -> SensorNoise:
        """Return a constant, for rendered depth without noise: it keeps the problem well posed."""
        return cls(sigma_m, 0.0, 0.01, depth_max_m)

    def sigma(self, z: NDArray[np.floating] | float) -> NDArray[np.floating]:
        """Return the axial standard deviation at range z, metres."""
        return self.a_m + self.b_per_m * np.square(z)

    def covariance(
        self,
        rays: NDArray[np.floating],  # (N, 3) unit vectors v
        ranges: NDArray[np.floating],  # (N,) z, metres
        lateral_px: float,
        focal_px: float,
    ) -> NDArray[np.float64]:
        """Return S(v, z; s) = sigma_perp^2 (I - v v^T) + sigma_par^2 v v^T, square metres.

        It is (N, 3, 3); sigma_perp = z s / f with s = `lateral_px`, sigma_par = sigma(z).
        """
        rays = np.asarray(rays, dtype=np.float64)
        ranges = np.asarray(ranges, dtype=np.float64)
        perpendicular = np.square(ranges * lateral_px / focal_px)[:, None, None]
        parallel = np.square(self.sigma(ranges))[:, None, None]
        along = rays[:, :, None] * rays[:, None, :]
        return perpendicular * (np.eye(3) - along) + parallel * along
