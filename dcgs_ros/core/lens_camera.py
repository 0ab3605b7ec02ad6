# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Cameras with any lens that OpenCV models; their images are rectified before they are used."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from .camera import LARGEST, CameraError, LensError, PinholeCamera

_WIDEST_RAD = np.radians(89.5)  # from the axis: what a rectified image cannot hold
_STEPS, _DIRECTIONS = 256, 64  # of the rays that are followed outwards
_FAR_PX = 1e18  # of pixels that absurd numbers put infinitely far away
_BLOCK = 1024  # points at once: OpenCV makes a Jacobian of 400 bytes for each
_ZOOM, _MOST_ZOOM = 1.02, 3.0  # of the rectified image, until the lens sees all of it
_LENGTHS = {True: (4,), False: (4, 5, 8, 12, 14)}  # of the distortion, by `fisheye`


@dataclass(frozen=True)
class LensCamera:
    """Intrinsics with OpenCV's fisheye model, or its rational one with up to 14 coefficients.

    `distortion` is (k1, k2, k3, k4) of the fisheye model (Kannala-Brandt, ROS's equidistant),
    else (k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tx, ty]]]]). Raises `CameraError` for
    a model that cannot be inverted over the image.
    """

    width: int
    height: int
    fx: float  # pixels
    fy: float  # pixels
    cx: float  # pixels
    cy: float  # pixels
    distortion: tuple[float, ...]
    fisheye: bool = False

    def __post_init__(self) -> None:
        """Check the numbers, and the lens."""
        self._pinhole(1.0)  # checks all but the lens
        lengths = _LENGTHS[self.fisheye]
        if len(self.distortion) not in lengths:
            raise CameraError(f'distortion has {len(self.distortion)} numbers, not {lengths}')
        if not np.all(np.abs(self.distortion) <= LARGEST):
            raise CameraError(f'distortion {self.distortion} is not usable')
        self._check_lens()
        _ = self.pinhole

    def _check_lens(self) -> None:
        """Check that, up to the image's border, rays farther out meet pixels farther out."""
        angle, turn = np.meshgrid(
            np.linspace(0.0, _WIDEST_RAD, _STEPS), np.linspace(0.0, 2 * np.pi, _DIRECTIONS)
        )
        across = np.sin(angle)
        rays = np.stack([across * np.cos(turn), across * np.sin(turn), np.cos(angle)], axis=-1)
        pixels = self.project(rays.reshape(-1, 3)).reshape(*angle.shape, 2)
        left = np.maximum.accumulate(~self._inside(pixels), axis=1)
        radii = np.linalg.norm(pixels - (self.cx, self.cy), axis=-1)
        stops = np.zeros(radii.shape, np.bool_)
        stops[:, :-1] = (np.diff(radii, axis=1) <= 0) & ~left[:, :-1]
        if not self.fisheye:  # which may see more than a rectified image can show
            stops[:, -1] = ~left[:, -1]
        turning = np.flatnonzero(stops.any(axis=1))
        if not len(turning):
            return
        reached = radii[turning, stops[turning].argmax(axis=1)].min()
        corners = [(u, v) for u in (0, self.width - 1) for v in (0, self.height - 1)]
        farthest = max(np.hypot(u - self.cx, v - self.cy) for u, v in corners)
        raise CameraError(
            f'the lens model cannot be inverted over the image: it turns back {reached:.0f} px '
            f'from the centre, the farthest corner is {farthest:.0f} px away (distortion '
            f'{self.distortion}); calibrate again, or rectify the images'
        )

    def project(self, points_cam: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return distorted pixels (N, 2) of points (N, 3) in the camera frame, z > 0."""
        points = np.ascontiguousarray(points_cam, np.float64).reshape(-1, 1, 3)
        blocks = np.array_split(points, max(1, -(-len(points) // _BLOCK)))
        return np.concatenate([self._project(block) for block in blocks])

    def _project(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        K = np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])
        still, D = np.zeros(3), np.array(self.distortion)
        if self.fisheye:
            pixels, _ = cv2.fisheye.projectPoints(points, still, still, K, D)
        else:
            pixels, _ = cv2.projectPoints(points, still, still, K, D)
        finite = np.nan_to_num(pixels.reshape(-1, 2), nan=_FAR_PX)
        return np.clip(finite, -_FAR_PX, _FAR_PX).astype(np.float32)

    @cached_property
    def pinhole(self) -> PinholeCamera:
        """The camera of the rectified images: no distortion, and the lens sees all its pixels.

        It has the same size, centre and, where that suffices, focal lengths.
        """
        zoom = 1.0
        while zoom < _MOST_ZOOM:
            camera = self._pinhole(zoom)
            if self._inside(self.project(border_rays(camera))).all():
                return camera
            zoom *= _ZOOM
        raise CameraError(
            f'no rectified image of {self.width}x{self.height} pixels lies inside the lens: its '
            f'centre is ({self.cx:.1f}, {self.cy:.1f})'
        )

    def _pinhole(self, zoom: float) -> PinholeCamera:
        fx, fy = zoom * self.fx, zoom * self.fy
        return PinholeCamera(self.width, self.height, fx, fy, self.cx, self.cy)

    def _inside(self, pixels: NDArray[np.floating]) -> NDArray[np.bool_]:
        size = (self.width - 0.5, self.height - 0.5)
        return np.all((pixels >= -0.5) & (pixels <= size), axis=-1)


Camera: TypeAlias = PinholeCamera | LensCamera


def make_camera(
    size: tuple[int, int],
    intrinsics: tuple[float, float, float, float],  # fx, fy, cx, cy in pixels
    distortion: tuple[float, ...],
    fisheye: bool = False,
) -> Camera:
    """Return the camera of images of that width and height: a `PinholeCamera` where that does.

    Raises `CameraError` for numbers that are no camera, or a lens that cannot be inverted.
    """
    plain = 4 if fisheye else 8
    if not any(distortion[plain:]):  # of zeros there may be any number
        distortion = distortion[:plain]
    if not fisheye and len(distortion) <= 8:
        with suppress(LensError):
            return PinholeCamera(*size, *intrinsics, distortion)
    return LensCamera(*size, *intrinsics, distortion, fisheye)


def border_rays(camera: PinholeCamera) -> NDArray[np.float64]:
    """Return points (N, 3), z = 1, that the camera sees along the border of its image."""
    u, v = np.linspace(0, camera.width - 1, 17), np.linspace(0, camera.height - 1, 17)
    ends_u, ends_v = u[[0, -1]], v[[0, -1]]
    sides = [np.stack(np.meshgrid(*pair), axis=-1) for pair in ((u, ends_v), (ends_u, v))]
    rays = camera.undistort(np.concatenate([side.reshape(-1, 2) for side in sides]))
    return np.column_stack([rays, np.ones(len(rays))]).astype(np.float64)
