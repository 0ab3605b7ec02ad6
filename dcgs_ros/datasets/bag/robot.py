# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which IMU and which wheel odometry of a recording are the camera's, and where they are."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...io.ros_images import MessageError, stamp_ns
from ..source import OdometrySample
from .extrinsics import Transforms, read_transform, static_transforms, transform_between
from .messages import IMU, ODOMETRY, decode
from .recording import first_messages, raw_messages, topic_types
from .recovery.losses import DamagedError

_OWN = 'dcgs_tracker/odometry'  # recorded beside its input, which it is no measurement for
_USUAL = 'odom', 'odometry'  # ends of topics
_BASES = 'base_footprint', 'base_link'  # REP 105, REP 120; where no odometry names one
_SAME_M, _SAME_RAD = 0.05, 1e-3  # between frames of one IMU, as of its gyro and accelerometer


@dataclass(frozen=True)
class RecordedRobot:
    """The sensors beside the camera."""

    imu_topics: tuple[str, ...] = ()
    imu_frames: tuple[str, ...] = ()
    T_cam_imu: NDArray[np.float64] | None = None  # (4, 4) to the colour camera; None: not known
    odometry_topic: str | None = None
    base_frame: str = ''
    T_base_cam: NDArray[np.float64] | None = None  # (4, 4); None: not known
    transforms: Transforms | None = None  # all that are static; None: some are no transforms


def find_robot(path: Path | str, color_topic: str) -> RecordedRobot:
    """Find the sensors of a recording, and in /tf_static where they are."""
    types = topic_types(path)
    imus = [topic for topic, type_ in types.items() if type_ == IMU]
    wheels = [t for t, type_ in types.items() if type_ == ODOMETRY and not t.endswith(_OWN)]
    first = first_messages(path, [*imus, *wheels, color_topic])
    camera = first[color_topic].header.frame_id.lstrip('/') if color_topic in first else ''
    transforms: Transforms | None = None
    with suppress(MessageError):
        transforms = static_transforms(path)
    tree = (transforms or {}) if camera else {}

    def placed(frame: str) -> NDArray[np.float64] | None:
        """Return T_cam_frame (4, 4)."""
        with suppress(MessageError):
            return transform_between(tree, camera, frame) if camera and frame else None
        return None

    frames = {t: first[t].header.frame_id.lstrip('/') for t in imus if t in first}
    places = {frame: placed(frame) for frame in frames.values()}
    topics = _of_one_imu(frames, places, color_topic)
    bases = {topic: first[topic].child_frame_id.lstrip('/') for topic in wheels if topic in first}
    topic = min(bases, key=lambda t: (placed(bases[t]) is None, *_strangeness(t)), default=None)
    base = bases[topic] if topic else next((b for b in _BASES if placed(b) is not None), '')
    T_cam_base = placed(base)
    return RecordedRobot(
        topics,
        tuple(dict.fromkeys(frames[t] for t in topics)),
        places[frames[topics[0]]] if topics else None,
        topic,
        base,
        None if T_cam_base is None else se3.inverse(T_cam_base),
        transforms,
    )


def odometry_samples(path: Path | str, topic: str) -> Iterator[OdometrySample]:
    """Read what wheels say, on the ground; unreadable messages are left out."""
    with suppress(DamagedError):  # reported with the frames
        for message in raw_messages(path, [topic]):
            with suppress(MessageError):
                odometry = decode(message.cdr, message.type)
                T = read_transform(odometry.pose.pose.position, odometry.pose.pose.orientation)
                linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
                velocity = float(linear.x), float(linear.y), float(angular.z)
                if not math.isfinite(sum(velocity)):
                    raise MessageError(f'{velocity} is no velocity')
                yield OdometrySample(
                    stamp_ns(odometry.header.stamp),
                    odometry.header.frame_id.lstrip('/'),
                    odometry.child_frame_id.lstrip('/'),
                    (float(T[0, 3]), float(T[1, 3]), math.atan2(T[1, 0], T[0, 0])),
                    velocity,
                )


def _of_one_imu(
    frames: dict[str, str], places: dict[str, NDArray[np.float64] | None], color_topic: str
) -> tuple[str, ...]:
    """Return the topics of the IMU nearest to the camera by its names, its gyro's first.

    One that is known to be somewhere is preferred.
    """
    gyros = [topic for topic in frames if 'accel' not in topic.lower()]
    if not gyros:
        return ()

    def strangeness(topic: str) -> tuple[bool, int, str]:
        shared = len(os.path.commonpath([topic, color_topic]))
        return places[frames[topic]] is None, -shared, topic

    best = min(gyros, key=strangeness)
    beside = best.lower().replace('gyro', 'accel')
    own = [
        topic
        for topic, frame in frames.items()
        if topic != best
        and (topic.lower() == beside or _is_same(places[frame], places[frames[best]]))
    ]
    return best, *own


def _is_same(a: NDArray[np.float64] | None, b: NDArray[np.float64] | None) -> bool:
    if a is None or b is None:
        return False
    turned = np.abs(a[:3, :3] - b[:3, :3]).max() > _SAME_RAD
    return not turned and float(np.linalg.norm(a[:3, 3] - b[:3, 3])) < _SAME_M


def _strangeness(topic: str) -> tuple[bool, bool, int, str]:
    """Return what sorts topics of odometry, that of wheels first."""
    unusual = topic.rpartition('/')[2] not in _USUAL
    return 'wheel' not in topic.lower(), unusual, len(topic), topic
