# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a sequence's other sensors measured, as the tracker takes it: in time with the frames."""

from __future__ import annotations

from collections.abc import Iterator
from heapq import merge

import numpy as np
from numpy.typing import NDArray

from ..core import se3
from ..core.config.stages import PriorsConfig
from ..core.priors.motion_priors import MotionPriors, PriorsError
from ..core.priors.readings import AngularRate, BasePose, Reading, SpecificForce
from .source import OdometrySample, RobotSource, Source

_AHEAD_NS = 20_000_000  # of a frame's stamp: what a camera takes to deliver the frame


def priors_of(source: Source, config: PriorsConfig) -> MotionPriors:
    """Return the priors of a sequence's tracker.

    Raises `PriorsError` where the sequence lacks a sensor that the configuration asks for.
    """
    priors = MotionPriors(config)
    if priors.unmounted and isinstance(source, RobotSource):
        T = source.T_cam_imu
        priors.mount(None if T is None else T[:3, :3], source.T_base_cam)
    if priors.unmounted:
        name, why = next(iter(priors.unmounted.items()))
        raise PriorsError(f'priors.{name}: {why}; a bag tells it in /tf_static')
    return priors


class Readings:
    """A sequence's readings in order of their stamps, handed out as far as frames have come."""

    def __init__(self, source: Source, config: PriorsConfig) -> None:
        """Read those that the configuration asks for, from the first."""
        kinds = []
        if config.needs_gyro and isinstance(source, RobotSource):
            kinds.append(_rates(source))
        if config.gravity and isinstance(source, RobotSource):
            kinds.append(_forces(source))
        if config.wheels and isinstance(source, RobotSource):
            kinds.append(_poses(source))
        self._left = merge(*kinds, key=lambda reading: reading.stamp_ns)
        self._next = next(self._left, None)

    def until(self, stamp_ns: int) -> Iterator[Reading]:
        """Yield those that were there when the frame of this stamp was."""
        while self._next is not None and self._next.stamp_ns <= stamp_ns + _AHEAD_NS:
            yield self._next
            self._next = next(self._left, None)


def base_pose(sample: OdometrySample) -> NDArray[np.float64]:
    """Return T_odom_base (4, 4) of a base on the ground."""
    x, y, heading = sample.pose
    half = 0.5 * heading
    quat_wxyz = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
    return se3.from_quaternion(quat_wxyz, np.array([x, y, 0.0]))


def _rates(source: RobotSource) -> Iterator[Reading]:
    for sample in source.imu():
        if sample.angular_velocity is not None and sample.frame in source.imu_frames:
            yield AngularRate(sample.stamp_ns, np.array(sample.angular_velocity))


def _forces(source: RobotSource) -> Iterator[Reading]:
    for sample in source.imu():
        if sample.acceleration is not None and sample.frame in source.imu_frames:
            yield SpecificForce(sample.stamp_ns, np.array(sample.acceleration))


def _poses(source: RobotSource) -> Iterator[Reading]:
    for sample in source.odometry():
        yield BasePose(sample.stamp_ns, base_pose(sample))
