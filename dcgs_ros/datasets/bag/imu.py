# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The IMU measurements of a recording."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from heapq import merge
from pathlib import Path
from typing import Any

from ...io.ros_images import MessageError, stamp_ns
from ..source import ImuSample
from .messages import IMU, decode
from .recording import raw_messages, topic_types
from .recovery.losses import DamagedError


def imu_samples(path: Path | str) -> Iterator[ImuSample]:
    """Read the samples of all Imu topics, merged by their stamps; unreadable ones are left out.

    A quantity is None where its covariance is -1 ('no value'), and on topics of accelerations or
    angular rates alone, where drivers fill the other quantity with zeros.
    """
    topics = [topic for topic, type_ in topic_types(path).items() if type_ == IMU]
    return merge(*(_samples(path, topic) for topic in topics), key=lambda sample: sample.stamp_ns)


def _samples(path: Path | str, topic: str) -> Iterator[ImuSample]:
    has_acceleration = 'gyro' not in topic.lower()
    has_rate = 'accel' not in topic.lower()
    with suppress(DamagedError):  # reported with the frames
        for message in raw_messages(path, [topic]):
            with suppress(MessageError):
                imu = decode(message.cdr, message.type)
                yield ImuSample(
                    stamp_ns(imu.header.stamp),
                    imu.header.frame_id,
                    _vector(imu.linear_acceleration, imu.linear_acceleration_covariance)
                    if has_acceleration
                    else None,
                    _vector(imu.angular_velocity, imu.angular_velocity_covariance)
                    if has_rate
                    else None,
                )


def _vector(value: Any, covariance: Any) -> tuple[float, float, float] | None:
    return None if covariance[0] == -1 else (value.x, value.y, value.z)
