# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The pose of the camera on the base."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.config.nodes import MapperNodeSettings, TrackerNodeSettings
from ...core.config.schema import ConfigError
from ...datasets.mounts import LOOKING_FORWARD
from ..messages.odometry import CameraToBase
from ..transforms import Transforms

_AGAIN_S = 0.2  # between two questions to TF
WHO_KNOWS = "start what publishes it, such as robot_state_publisher or the camera's driver"
_UNIT = 1e-3  # largest distance of a quaternion's length from 1


class Mounting:
    """Where the camera is on the base: TF is waited for, and taken where it comes even later."""

    def __init__(
        self, settings: TrackerNodeSettings, transforms: Transforms, warn: Callable[[str], None]
    ) -> None:
        """`warn` gets the lines for the log; raises `ConfigError` for an unusable setting."""
        given_extrinsics(settings)  # raises now rather than at the first frame
        self._settings, self._transforms, self._warn = settings, transforms, warn
        self._to_base: CameraToBase | None = None
        self._asked_s: float | None = None  # monotonic
        self._due_s = 0.0
        self.doubt: str | None = None  # what is to be done about it; None: it is certain

    def find(self, camera_frame: str) -> CameraToBase | None:
        """Return where the camera is; None while that is waited for."""
        now = time.monotonic()
        if now >= self._due_s and (self._to_base is None or self.doubt is not None):
            self._due_s = now + _AGAIN_S
            self._look(camera_frame, now)
        return self._to_base

    def _look(self, camera_frame: str, now: float) -> None:
        settings = self._settings
        names = f'TF from {settings.base_frame} to {camera_frame}'
        found = known_extrinsics(settings, self._transforms, camera_frame)
        if found is not None:
            if self.doubt is not None:
                self._warn(f'{names} has come')
            self._to_base, self.doubt = CameraToBase(found), None
            return
        if self._to_base is not None:
            return
        self._asked_s = now if self._asked_s is None else self._asked_s
        wait_s, listens = settings.wait_for_transform_s, self._transforms.listens
        if listens and now - self._asked_s < wait_s:
            doubt = f'waiting for {names}, at most {wait_s:g} s: {WHO_KNOWS}'
        else:
            self._to_base = CameraToBase(LOOKING_FORWARD)
            doubt = (
                f'no {names}: the camera is taken to look along x from the origin of '
                f'{settings.base_frame}, and poses are wrong unless it does; '
                f'{WHO_KNOWS + ", or " if listens else ""}set node.base_to_camera'
            )
        if doubt != self.doubt:
            self._warn(doubt)
        self.doubt = doubt if listens else None  # without tf2_ros nothing will come


def known_extrinsics(
    settings: TrackerNodeSettings | MapperNodeSettings, transforms: Transforms, camera_frame: str
) -> NDArray[np.float64] | None:
    """Return T_base_cam (4, 4), optical frame: as set, else from TF; None where that lacks it."""
    given = given_extrinsics(settings)
    if given is not None:
        return given
    if settings.base_frame == camera_frame:
        return np.eye(4)
    return transforms.lookup(settings.base_frame, camera_frame)


def given_extrinsics(
    settings: TrackerNodeSettings | MapperNodeSettings,
) -> NDArray[np.float64] | None:
    """Return T_base_cam (4, 4) as set, None for 'auto'; raise `ConfigError` for anything else."""
    return parse_pose('node.base_to_camera', settings.base_to_camera)


def parse_pose(key: str, text: str) -> NDArray[np.float64] | None:
    """Return a setting `key` as a transform (4, 4), None for 'auto'; else raise `ConfigError`."""
    if text == 'auto':
        return None
    try:
        numbers = np.array([float(word) for word in text.replace(',', ' ').split()])
    except ValueError:
        numbers = np.empty(0)
    length = np.linalg.norm(numbers[3:])
    if len(numbers) != 7 or not np.isfinite(numbers).all() or abs(length - 1) > _UNIT:
        raise ConfigError(
            f"{key} is {text!r}, not 'auto' or 'x y z qx qy qz qw' with a unit quaternion"
        )
    x, y, z, w = numbers[3:] / length
    return se3.from_quaternion(np.array([w, x, y, z]), numbers[:3])
