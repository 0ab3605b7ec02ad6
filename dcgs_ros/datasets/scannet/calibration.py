# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""ScanNet's cameras, from its calibration matrices, which are checked first."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.camera import CameraError, PinholeCamera
from ..camera_presets import PRESETS
from ..images.color_resampling import ColorResampling, color_resampling
from ..parsing.intrinsics import parse_intrinsics
from ..parsing.pose_matrices import are_rigid
from ..source import SourceError


def make_resampling(
    path: Path,
    K_color: NDArray[np.floating],
    color_size: tuple[int, int],
    depth_camera: PinholeCamera,
    T_rig_color: NDArray[np.floating],
    T_rig_depth: NDArray[np.floating],
) -> ColorResampling:
    """Return the resampling of colour to depth by their intrinsics and extrinsics (4, 4).

    Raises `SourceError` with `path`, the file or folder of the calibration.
    """
    color_camera = _camera(path, K_color, color_size, 'colour')
    for name, T in (('colour', T_rig_color), ('depth', T_rig_depth)):
        if not are_rigid(T[None])[0]:
            raise SourceError(f'{path}: extrinsics of {name} {T.tolist()} are not a rigid motion')
    try:
        return color_resampling(color_camera, depth_camera, se3.inverse(T_rig_color) @ T_rig_depth)
    except SourceError as error:
        raise SourceError(f'{path}: {error}') from error


def make_depth_camera(
    path: Path, given: str | None, K_depth: NDArray[np.floating], size: tuple[int, int]
) -> PinholeCamera:
    """Return the camera of depth images of that width and height: `given`, or K (4, 4)."""
    if given is None:
        return _camera(path, K_depth, size, 'depth')
    camera = PRESETS[given].camera if given in PRESETS else parse_intrinsics(given, *size)
    if (camera.width, camera.height) != size:
        raise SourceError(
            f'{path}: camera {given} has {camera.width}x{camera.height} pixels, '
            f'the depth images {size[0]}x{size[1]}'
        )
    return camera


def _camera(
    path: Path, K: NDArray[np.floating], size: tuple[int, int], name: str
) -> PinholeCamera:
    """Return the camera with K (4, 4) for images of that width and height."""
    try:
        fx, fy, cx, cy = (float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        camera = PinholeCamera(*size, fx, fy, cx, cy)
    except CameraError as error:
        raise SourceError(f'{path}: {name}: {error}') from error
    if not (0 < camera.cx < camera.width and 0 < camera.cy < camera.height):
        raise SourceError(
            f'{path}: the centre ({camera.cx:.6g}, {camera.cy:.6g}) of {name} is outside of its '
            f'{camera.width}x{camera.height} pixels: intrinsics of another size'
        )
    return camera
