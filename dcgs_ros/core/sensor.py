# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a depth camera's measurements are worth: the noise laws and the covariance S(v, z; s)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .config.schema import described
from .errors import DcgsError


class SensorError(DcgsError):
    """Noise parameters outside their range."""


@dataclass(frozen=True)
class SensorNoise:
    """Axial noise sigma_z(z) = A + B z^2 (paper, tracking covariance) and the usable range.

    The law is stated for depth; like the paper we feed it the range |a|, which overstates sigma by
    at most 1 / cos^2 of the field-of-view's half angle in the image corners.
    """

    a_m: float = described(
        0.0012, 'A of the depth noise A + B z^2: standard deviation at no distance, metres.'
    )
    b_per_m: float = described(
        0.0014, 'B of the depth noise A + B z^2: its growth with the squared distance, 1/metre.'
    )
    depth_min_m: float = described(0.3, 'Nearer depth is not used, metres.')
    depth_max_m: float = described(5.0, 'Farther depth is not used, metres.')

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not (self.a_m > 0 and self.b_per_m >= 0):
            raise SensorError(f'need a_m > 0 and b_per_m >= 0, got {self.a_m} and {self.b_per_m}')
        if not 0 <= self.depth_min_m < self.depth_max_m:
            raise SensorError(
                f'need 0 <= depth_min_m < depth_max_m, got {self.depth_min_m} '
                f'and {self.depth_max_m}'
            )

    @classmethod
    def structured_light(cls) -> SensorNoise:
        """Kinect v1: A + B z^2 fitted to Nguyen 2012's 0.0012 + 0.0019 (z - 0.4)^2 m, 0.4-3 m."""
        return cls()

    @classmethod
    def stereo(
        cls,
        depth_focal_px: float,
        baseline_m: float,
        subpixel_px: float = 0.08,
        depth_min_m: float = 0.25,
        depth_max_m: float = 6.0,
    ) -> SensorNoise:
        """Active stereo: dz = z^2 / (f b) d(disparity).

        `depth_focal_px` is that of the DEPTH imager, also where depth is aligned to colour.
        """
        if depth_focal_px <= 0 or baseline_m <= 0 or subpixel_px < 0:
            raise SensorError(
                f'need focal > 0 px, baseline > 0 m, subpixel >= 0 px, got {depth_focal_px}, '
                f'{baseline_m}, {subpixel_px}'
            )
        return cls(0.001, subpixel_px / (depth_focal_px * baseline_m), depth_min_m, depth_max_m)

    @classmethod
    def floor(cls, sigma_m: float = 0.001, depth_max_m: float = 12.0) -> SensorNoise:
        """Take rendered depth without noise: a constant keeps the problem well posed."""
        return cls(sigma_m, 0.0, 0.01, depth_max_m)

    def sigma(self, z: NDArray | float) -> NDArray:
        """Axial standard deviation at range z, metres."""
        return self.a_m + self.b_per_m * np.square(z)

    def covariance(
        self, rays: NDArray, ranges: NDArray, lateral_px: float, focal_px: float
    ) -> NDArray[np.float64]:
        """S(v, z; s) = sigma_perp^2 (I - v v^T) + sigma_par^2 v v^T, square metres.

        `rays` (N, 3) are unit vectors v, `ranges` (N,) metres; sigma_perp = z s / f. Returns
        (N, 3, 3).
        """
        rays = np.asarray(rays, dtype=np.float64)
        ranges = np.asarray(ranges, dtype=np.float64)
        perpendicular = np.square(ranges * lateral_px / focal_px)[:, None, None]
        parallel = np.square(self.sigma(ranges))[:, None, None]
        along = rays[:, :, None] * rays[:, None, :]
        return perpendicular * (np.eye(3) - along) + parallel * along
