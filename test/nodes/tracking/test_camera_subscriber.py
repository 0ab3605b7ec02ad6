# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Two messages become a frame, with depth in metres."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('rclpy')

from dcgs_ros.nodes.messages.images import header, write_color, write_depth, write_depth_mm
from dcgs_ros.nodes.tracking.camera_subscriber import read_frame
from dcgs_ros.nodes.tracking.pairing import ImagePair

COLOR = np.zeros((24, 32, 3), np.uint8)
DEPTH_M = np.full((24, 32), 1.5, np.float32)
HEADER = header(10**18, 'camera')
UNITS = {
    'millimetres': (write_depth_mm(DEPTH_M, HEADER), None),
    'metres': (write_depth(DEPTH_M, HEADER), None),
    'quarters of a millimetre': (write_depth_mm(4 * DEPTH_M, HEADER), 4000.0),
    'floats in millimetres': (write_depth(1000 * DEPTH_M, HEADER), 1000.0),
}


@pytest.mark.parametrize('unit', UNITS)
def test_depth_is_read_in_ros_units_or_the_one_that_is_told(unit: str) -> None:
    depth, per_metre = UNITS[unit]
    pair = ImagePair(10**18, write_color(COLOR, HEADER), 10**18, depth)
    np.testing.assert_array_equal(read_frame(pair, per_metre).depth_m, DEPTH_M)
