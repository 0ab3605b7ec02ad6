# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Corrected poses as a cloud: exact, or refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')

from rclpy.serialization import deserialize_message, serialize_message

from dcgs_ros.core import se3
from dcgs_ros.core.errors import DcgsError
from dcgs_ros.core.keyframe import Correction
from dcgs_ros.core.tracking.visited import origin
from dcgs_ros.io.ros_images import stamp_ns
from dcgs_ros.nodes.messages.clouds import CORRECTED_POSE, read_cloud, write_cloud
from dcgs_ros.nodes.messages.corrections import read_correction, write_correction
from dcgs_ros.nodes.messages.ids import EPOCH, first_epoch

POSE = 1e-12
STAMP = 1_700_000_000_999_999_999
FIRST = first_epoch()


def correction_of(count: int = 5, revision: int = 3) -> Correction:
    rng = np.random.default_rng(1)
    T = np.array([se3.exp(xi) for xi in rng.normal(size=(count, 6))])
    T[2:, :3, 3] += origin(1)
    stamps = STAMP + np.arange(count) * 10**9
    submaps = np.array([0, 0, 1, 1, 1][:count], np.int32)
    return Correction(revision, stamps, T, np.zeros((count, 6, 6)), submaps)


def test_a_correction_arrives_as_it_was() -> None:
    """To the last bits, also where a sub-map is a kilometre away."""
    sent = correction_of()
    cloud = write_correction(sent, FIRST, 'map')
    epoch, found = read_correction(deserialize_message(serialize_message(cloud), type(cloud)))
    assert (epoch, found.revision) == (FIRST, 3)
    np.testing.assert_array_equal(found.stamps_ns, sent.stamps_ns)
    np.testing.assert_array_equal(found.submaps, sent.submaps)
    np.testing.assert_allclose(found.T_world_cam, sent.T_world_cam, atol=POSE)
    assert np.isnan(found.covariances).all()  # they are not sent
    assert cloud.header.frame_id == 'map'
    assert stamp_ns(cloud.header.stamp) == STAMP + 4 * 10**9


@pytest.mark.parametrize(
    ('field', 'values'),
    [('revision', [1, 2]), ('id', [FIRST * EPOCH, (FIRST + 1) * EPOCH]), ('id', [3.0, 4.0]),
     ('id', [np.nan, 0.0]), ('x', [np.inf, 0.0]), ('qw', [0.0, 0.0]), ('nanosec', [7, 7])],
)  # fmt: skip
def test_a_correction_that_is_none_is_refused(field: str, values: list[Any]) -> None:
    cloud = write_correction(correction_of(2), FIRST, 'map')
    rows = read_cloud(cloud, CORRECTED_POSE)
    rows[field] = values
    if field == 'qw':
        for name in ('qx', 'qy', 'qz'):
            rows[name] = 0.0
    rows['sec'] = 5
    with pytest.raises(DcgsError):
        read_correction(write_cloud(rows, cloud.header))
    with pytest.raises(DcgsError):
        read_correction(write_cloud(rows[:0], cloud.header))
