# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera as CameraInfo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip('rclpy')

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.io.ros_images import read_camera
from dcgs_ros.nodes.messages.standard import header, write_camera

HEADER = header(5, 'camera')
PIXELS = st.floats(1.0, 5000.0)
COEFFICIENTS = st.sampled_from([0, 4, 5, 8]).flatmap(
    lambda count: st.tuples(*[st.floats(-1.0, 1.0)] * count)
)
CAMERAS = st.builds(
    PinholeCamera,
    st.integers(16, 8192),
    st.integers(16, 8192),
    PIXELS,
    PIXELS,
    PIXELS,
    PIXELS,
    COEFFICIENTS,
)


@settings(max_examples=100)
@given(CAMERAS)
def test_a_camera_survives_exactly(camera: PinholeCamera) -> None:
    message = deserialize_message(serialize_message(write_camera(camera, HEADER)), CameraInfo)
    again = read_camera(message)
    assert (again.width, again.height) == (camera.width, camera.height)
    np.testing.assert_array_equal(again.parameters, camera.parameters)
    assert read_camera(write_camera(again, HEADER)) == again


@pytest.mark.parametrize(
    ('count', 'model', 'written'),
    [(0, 'plumb_bob', 5), (4, 'plumb_bob', 5), (5, 'plumb_bob', 5), (8, 'rational_polynomial', 8)],
)
def test_a_lens_has_the_numbers_that_ros_gives_its_model(
    count: int, model: str, written: int
) -> None:
    camera = PinholeCamera(640, 480, 525.0, 526.0, 319.5, 239.5, (0.01,) * count)
    message = write_camera(camera, HEADER)
    assert message.distortion_model == model
    assert list(message.d) == [0.01] * count + [0.0] * (written - count)


def test_the_projection_is_the_cameras_own() -> None:
    message = write_camera(PinholeCamera(640, 480, 525.0, 526.0, 319.5, 239.5), HEADER)
    assert list(message.k) == [525.0, 0, 319.5, 0, 526.0, 239.5, 0, 0, 1]
    assert list(message.p) == [525.0, 0, 319.5, 0, 0, 526.0, 239.5, 0, 0, 0, 1, 0]
    np.testing.assert_array_equal(message.r.reshape(3, 3), np.eye(3))
