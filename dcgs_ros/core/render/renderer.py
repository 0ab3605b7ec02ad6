# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The interface of the renderers: an image of Gaussians seen by a camera, and its gradients.

A Gaussian's alpha at a pixel is min(o exp(-d' Sigma_2D^-1 d / 2), ALPHA_MAX), with the projected
covariance widened by BLUR_PX2 on its diagonal; below ALPHA_MIN it is 0. Gaussians are blended
front to back by the depth of their means, equal ones in the order of the array. The first one that
would bring a pixel's transmittance to T_MIN or less ends that pixel and is not blended itself.
Gaussians nearer than NEAR_M, and those farther than the view goes, are not drawn. The Jacobian of
the projection is taken at the mean, clamped to within MARGIN of half the image's size beyond its
border. (Kerbl et al. 2023, with the constants of gsplat.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..camera import PinholeCamera
from ..errors import DcgsError

ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.999
T_MIN = 1e-4
BLUR_PX2 = 0.3
NEAR_M = 0.05
FAR_M = 500.0  # no depth camera sees so far, and sub-maps that are not joined are farther apart
MARGIN = 0.3


class RenderError(DcgsError):
    """The arguments cannot be rendered, or the backend is not available."""


@dataclass(frozen=True)
class View:
    """A pinhole camera without distortion, and its pose."""

    width: int
    height: int
    fx: float  # pixels
    fy: float
    cx: float  # pixels; the centre of the first pixel is (0, 0), as in `PinholeCamera`
    cy: float
    T_world_cam: NDArray[np.float64]  # (4, 4)
    far_m: float = math.inf  # Gaussians at that depth and beyond are not drawn

    def __post_init__(self) -> None:
        """Check that an image can be rendered."""
        if self.width < 1 or self.height < 1:
            raise RenderError(f'an image of {self.width}x{self.height} pixels is empty')
        numbers = (self.fx, self.fy, self.cx, self.cy)
        if not np.all(np.isfinite(numbers)) or self.fx <= 0 or self.fy <= 0:
            raise RenderError(f'intrinsics fx fy cx cy = {numbers} are not usable')
        if self.T_world_cam.shape != (4, 4) or not np.all(np.isfinite(self.T_world_cam)):
            raise RenderError(f'pose is not a finite (4, 4) matrix: {self.T_world_cam}')

    @classmethod
    def of(cls, camera: PinholeCamera, T_world_cam: NDArray[np.floating], shrink: int = 1) -> View:
        """Return `camera` without its distortion, with one pixel for each shrink x shrink.

        It goes as far as FAR_M.
        """
        return cls(
            camera.width // shrink, camera.height // shrink, camera.fx / shrink,
            camera.fy / shrink, (camera.cx + 0.5) / shrink - 0.5, (camera.cy + 0.5) / shrink - 0.5,
            np.asarray(T_world_cam, np.float64), FAR_M,
        )  # fmt: skip


@dataclass(frozen=True)
class Rendering:
    """One image, planar: colour and depth composited over black, and the transmittance."""

    planes: NDArray[np.float32]  # (5, H, W): red, green, blue, depth, transmittance

    @property
    def color(self) -> NDArray[np.float32]:
        """(3, H, W) sum of w_i c_i; 0 to 1 if the Gaussians' colours are."""
        return self.planes[:3]

    @property
    def depth(self) -> NDArray[np.float32]:
        """(H, W) sum of w_i z_i, metres: depth times (1 - transmittance)."""
        return self.planes[3]

    @property
    def transmittance(self) -> NDArray[np.float32]:
        """(H, W) product of 1 - alpha_i."""
        return self.planes[4]


@dataclass(frozen=True)
class Gradients:
    """Derivatives of a loss with respect to what was rendered."""

    planes: NDArray[np.float32]  # (14, N) by the parameters; valid only if touched
    touched: NDArray[np.bool_]  # (N,) Gaussians that have a gradient
    pose: NDArray[np.float64]  # (6,) by xi in T_world_cam exp(xi), translation first
    weights: NDArray[np.float32]  # (N,) each Gaussian's blending weights, summed over the pixels


class Renderer(Protocol):
    """A rendering backend. Results are views of its buffers, valid until its next call."""

    def render(self, planes: NDArray[np.float32], view: View) -> Rendering:
        """Return an image of the Gaussians of `planes` (14, N), as in `Splats`.

        Gaussians with parameters that are not finite are not drawn. Raises `RenderError` for
        planes of another shape or type, and for more than the backend can hold.
        """
        ...

    def backward(self, gradient: NDArray[np.float32]) -> Gradients:
        """Return the derivatives, given dL / d planes (5, H, W) of the last rendering.

        Raises `RenderError` for a gradient of another shape or type.
        """
        ...
