# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""An IMU and wheel odometry beside 30 images a second, over DDS from a bag."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')
pytest.importorskip('rosbags')

from dcgs_ros.datasets.bag.source import BagSource
from dcgs_ros.datasets.bag.writing.storage import BagOptions
from dcgs_ros.datasets.bag.writing.writer import write_bag
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.nodes.demo import play, sensors_of
from dcgs_ros.nodes.tracking.extrinsics import parse_pose

FRAMES = 60
LEAST = 0.9  # of the frames, on a machine that others load
ATE_CM = 3.0


def test_sensors_are_placed_by_parameters() -> None:
    source = SyntheticSource.from_address('synthetic:corridor?frames=1')
    chosen = sensors_of(source)
    for key, T in (('camera_to_imu', source.T_cam_imu), ('base_to_camera', source.T_base_cam)):
        text = chosen[f'node.{key}']
        assert T is not None and isinstance(text, str)
        found = parse_pose(key, text)
        assert found is not None
        np.testing.assert_allclose(found, T, atol=1e-6)
    hand = sensors_of(SyntheticSource.from_address('synthetic:room?frames=1'))
    assert 'priors.wheels' not in hand and hand['priors.gyro'] is True


@pytest.mark.slow
def test_imu_and_odometry_come_beside_images(tmp_path: Path) -> None:
    source = SyntheticSource.from_address(f'synthetic:ring?frames={FRAMES}&sensor=d435i')
    write_bag(tmp_path / 'bag', source, map(source.render, range(FRAMES)), BagOptions())
    assert BagSource(tmp_path / 'bag').T_base_cam is not None
    found = play(str(tmp_path / 'bag'), 0.25, False, tmp_path, with_priors=True)
    assert found.priors == {'gyro': 'used', 'wheels': 'used'}
    assert found.tracked >= LEAST * FRAMES
    assert found.ate_cm is not None and found.ate_cm < ATE_CM
