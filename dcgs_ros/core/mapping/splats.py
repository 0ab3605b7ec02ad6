# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Gaussians of the mapper: mean, Sigma_r as rotation and log-scale, opacity, colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import DcgsError
from ..shape import normals_and_flatness

# One plane for each parameter, named like the properties of the common 3DGS PLY.
PLANES = (
    'x', 'y', 'z', 'scale_0', 'scale_1', 'scale_2', 'rot_0', 'rot_1', 'rot_2', 'rot_3', 'opacity',
    'f_dc_0', 'f_dc_1', 'f_dc_2',
)  # fmt: skip
SH_C0 = 0.28209479177387814  # Y_00: a colour is 1/2 + SH_C0 f_dc


class SplatError(DcgsError):
    """Arrays that do not form a set of Gaussians."""


@dataclass(frozen=True)
class Splats:
    """N Gaussians as planes, the form that renderer, optimiser and files share."""

    planes: NDArray[np.float32]  # (14, N) in the order of PLANES

    def __post_init__(self) -> None:
        """Check shape and type."""
        if self.planes.ndim != 2 or len(self.planes) != len(PLANES):
            raise SplatError(f'planes are {self.planes.shape}, not ({len(PLANES)}, N)')
        if self.planes.dtype != np.float32:
            raise SplatError(f'planes are {self.planes.dtype}, not float32')

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return self.planes.shape[1]

    @property
    def means(self) -> NDArray[np.float32]:
        """(3, N) metres, world."""
        return self.planes[0:3]

    @property
    def log_scales(self) -> NDArray[np.float32]:
        """(3, N) logarithm of the standard deviations of Sigma_r along its axes, metres."""
        return self.planes[3:6]

    @property
    def quats_wxyz(self) -> NDArray[np.float32]:
        """(4, N) rotation of the axes of Sigma_r to the world, of any nonzero length."""
        return self.planes[6:10]

    @property
    def opacity_logits(self) -> NDArray[np.float32]:
        """(N,) logit of the opacity."""
        return self.planes[10]

    @property
    def sh_dc(self) -> NDArray[np.float32]:
        """(3, N) spherical harmonics of degree 0: the colour is 1/2 + SH_C0 sh_dc."""
        return self.planes[11:14]

    def shape(self, columns: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the thinnest axes (K, 3), unit, world, and lambda3 / lambda2 (K,) of Sigma_r."""
        return normals_and_flatness(self.log_scales[:, columns], self.quats_wxyz[:, columns])
