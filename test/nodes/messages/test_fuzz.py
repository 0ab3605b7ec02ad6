# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Ten thousand broken messages: each is read or refused, and none costs memory."""

from __future__ import annotations

import gc
import random
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')

from geometry_msgs.msg import Pose
from sensor_msgs.msg import CameraInfo, PointCloud2

from dcgs_ros.core.camera import CameraError, PinholeCamera
from dcgs_ros.io.ros_images import MessageError, read_camera, read_color, read_depth
from dcgs_ros.nodes.messages.clouds import KEYFRAME_GAUSSIAN, read_cloud, write_cloud
from dcgs_ros.nodes.messages.images import (
    header,
    write_camera,
    write_color,
    write_depth,
    write_depth_mm,
)
from dcgs_ros.nodes.messages.poses import matrix, pose_message

MESSAGES = 10_000
PEAK_BYTES = 3_000_000  # checking a lens takes 2 MB; what broken messages claim is 2 GB
KEPT_BYTES = 100_000
HEADER = header(1, 'camera')
COLOR = np.zeros((48, 64, 3), np.uint8)
DEPTH = np.ones((48, 64), np.float32)
CAMERA = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5, (0.1,) * 5)
ENCODINGS = ('rgb8', 'bgr8', 'mono8', '16UC1', 'mono16', '32FC1', 'rgba8', '', 'jpeg', 'é' * 999)
MODELS = ('plumb_bob', 'rational_polynomial', 'equidistant', '', '\0')
# Sizes that are wrong by one, by a factor, and by all of 32 bits: 2 GB and more are claimed.
SIZES = (0, 1, 2, 47, 48, 49, 64, 192, 193, 16384, 16385, 2**16, 2**20, 2**31 - 1, 2**32 - 1)
NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-320, 1e308, 1.0)

Break = Callable[[Any, random.Random], None]


def sized(name: str) -> Break:
    return lambda message, rng: setattr(message, name, rng.choice(SIZES))


def one_of(name: str, values: tuple[str, ...]) -> Break:
    return lambda message, rng: setattr(message, name, rng.choice(values))


def flag(name: str, kind: type) -> Break:
    return lambda message, rng: setattr(message, name, kind(rng.randrange(2)))


def shorter(message: Any, rng: random.Random) -> None:
    message.data = message.data[: rng.randrange(len(message.data) + 1)]


def other_bytes(message: Any, rng: random.Random) -> None:
    message.data = rng.randbytes(len(message.data))


def numbers(name: str) -> Break:
    def change(message: Any, rng: random.Random) -> None:
        values = getattr(message, name)
        if len(values):
            values[rng.randrange(len(values))] = rng.choice(NUMBERS)

    return change


def another_length(message: CameraInfo, rng: random.Random) -> None:
    message.d = [rng.random()] * rng.randrange(20)


def field(message: PointCloud2, rng: random.Random) -> None:
    if not message.fields:
        return
    broken = rng.choice(message.fields)
    name = rng.choice(('name', 'offset', 'datatype', 'count'))
    value = 'é' if name == 'name' else rng.choice(SIZES) % (256 if name == 'datatype' else 2**32)
    setattr(broken, name, value)


def fewer_fields(message: PointCloud2, rng: random.Random) -> None:
    message.fields = message.fields[: rng.randrange(len(message.fields) + 1)]


def coordinate(message: Pose, rng: random.Random) -> None:
    part = message.position if rng.random() < 0.5 else message.orientation
    setattr(part, rng.choice('xyz'), rng.choice(NUMBERS))
    message.orientation.w = rng.choice((*NUMBERS, 1.0, 1.0, 1.0))


IMAGE_FAULTS: tuple[Break, ...] = (
    sized('width'), sized('height'), sized('step'), one_of('encoding', ENCODINGS),
    flag('is_bigendian', int), shorter, other_bytes,
)  # fmt: skip
INFO_FAULTS: tuple[Break, ...] = (
    sized('width'), sized('height'), one_of('distortion_model', MODELS), numbers('k'),
    numbers('d'), another_length,
)  # fmt: skip
CLOUD_FAULTS: tuple[Break, ...] = (
    sized('width'), sized('height'), sized('point_step'), sized('row_step'),
    flag('is_bigendian', bool), field, fewer_fields, shorter, other_bytes,
)  # fmt: skip
Kind = tuple[Callable[[], Any], tuple[Break, ...], Callable[[Any], Any]]
KINDS: tuple[Kind, ...] = (
    (lambda: write_color(COLOR, HEADER), IMAGE_FAULTS, read_color),
    (lambda: write_depth_mm(DEPTH, HEADER), IMAGE_FAULTS, read_depth),
    (lambda: write_depth(DEPTH, HEADER), IMAGE_FAULTS, read_depth),
    (lambda: write_camera(CAMERA, HEADER), INFO_FAULTS, read_camera),
    (
        lambda: write_cloud(np.zeros(40, KEYFRAME_GAUSSIAN), HEADER),
        CLOUD_FAULTS,
        lambda cloud: read_cloud(cloud, KEYFRAME_GAUSSIAN),
    ),
    (lambda: pose_message(np.eye(4)), (coordinate,), matrix),
)


def read_or_refuse(kind: Kind, rng: random.Random) -> bool:
    """Break a good message in one to three places; return whether it could still be read."""
    make, faults, read = kind
    message = make()
    for _ in range(rng.randint(1, 3)):
        rng.choice(faults)(message, rng)
    try:
        read(message)
    except (MessageError, CameraError) as error:
        assert '\n' not in str(error) and len(str(error)) < 500
        return False
    return True


@pytest.mark.slow
@pytest.mark.filterwarnings('error')
def test_ten_thousand_broken_messages_are_read_or_refused_in_flat_memory() -> None:
    rng = random.Random(0)
    for k in range(MESSAGES // 5):  # what is imported and cached once
        read_or_refuse(KINDS[k % len(KINDS)], rng)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        read = sum(read_or_refuse(KINDS[k % len(KINDS)], rng) for k in range(MESSAGES))
        gc.collect()
        after, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak - before < PEAK_BYTES
    assert after - before < KEPT_BYTES
    assert 0.1 < read / MESSAGES < 0.9  # the faults reach both ends
