# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The pose of the camera on the base."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.config.nodes import TrackerNodeSettings
from ...core.config.schema import ConfigError
from ..transforms import Transforms

# REP 103: the optical frame has z forward and x right, the base x forward and z up.
LOOKING_FORWARD = se3.from_quaternion(np.array([0.5, -0.5, 0.5, -0.5]), np.zeros(3))
_UNIT = 1e-3  # largest distance of a quaternion's length from 1


def base_to_camera(
    settings: TrackerNodeSettings, transforms: Transforms, camera_frame: str
) -> NDArray[np.float64]:
    """Return T_base_cam (4, 4), optical frame: as set, else from TF, else looking forward."""
    given = given_extrinsics(settings)
    if given is not None:
        return given
    if settings.base_frame == camera_frame:
        return np.eye(4)
    known = transforms.lookup(settings.base_frame, camera_frame)
    return LOOKING_FORWARD if known is None else known


def given_extrinsics(settings: TrackerNodeSettings) -> NDArray[np.float64] | None:
    """Return T_base_cam (4, 4) as set, None for 'auto'; raise `ConfigError` for anything else."""
    text = settings.base_to_camera
    if text == 'auto':
        return None
    try:
        numbers = np.array([float(word) for word in text.replace(',', ' ').split()])
    except ValueError:
        numbers = np.empty(0)
    length = np.linalg.norm(numbers[3:])
    if len(numbers) != 7 or not np.isfinite(numbers).all() or abs(length - 1) > _UNIT:
        raise ConfigError(
            f"node.base_to_camera is {text!r}, not 'auto' or 'x y z qx qy qz qw' with a unit "
            'quaternion'
        )
    x, y, z, w = numbers[3:] / length
    return se3.from_quaternion(np.array([w, x, y, z]), numbers[:3])
