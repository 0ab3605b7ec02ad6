# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Every frame says what it was worth, with its image's stamp, to those who listen."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')

from rclpy.node import Node

from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.nodes.messages.images import time_message
from dcgs_ros.nodes.tracking.frame_info import FrameInfo

STAMP_NS = 1_700_000_000_123_456_789
PRIORS = {'gyro': 'used', 'wheels': 'no reading for 0.5 s'}


def result_in(state: TrackingState) -> TrackResult:
    covariance = np.diag([1e-6, 4e-6, 1e-6, 1e-8, 1e-8, np.radians(0.5) ** 2])
    return TrackResult(
        STAMP_NS, np.eye(4), np.eye(4), covariance, covariance, state, None, 2000, 1500, 120, True,
        (), -3.5,
    )  # fmt: skip


@pytest.fixture
def node(ros: None) -> Iterator[Node]:
    made = Node('eye', namespace='robot1')
    yield made
    made.destroy_node()


def published(node: Node, state: TrackingState, listeners: int = 1) -> list[Any]:
    info, sent = FrameInfo(node), list[Any]()
    assert info._publisher.topic_name == '/robot1/eye/frame_info'
    info._publisher = SimpleNamespace(  # type: ignore[assignment]
        publish=sent.append, get_subscription_count=lambda: listeners
    )
    info.publish(result_in(state), 12.5, lambda: PRIORS)
    return sent


def test_it_has_what_the_frame_was_worth(node: Node) -> None:
    (message,) = published(node, TrackingState.OK)
    assert message.header.stamp == time_message(STAMP_NS)
    (status,) = message.status
    assert (status.name, status.message) == ('robot1/eye: frame', 'ok')
    shown = {value.key: value.value for value in status.values}
    expected = {
        'state': 'ok', 'sigma_m': '0.002', 'sigma_deg': '0.5', 'inliers': '1500',
        'landmarks': '120', 'ms': '12.5', 'keyframe': 'True', 'carried': 'False',
        'prior': 'constant velocity, gyro',
    }  # fmt: skip
    assert shown.items() >= expected.items()


@pytest.mark.parametrize(
    ('state', 'level'),
    [
        (TrackingState.OK, b'\x00'),
        (TrackingState.DEGENERATE, b'\x01'),
        (TrackingState.LOST, b'\x02'),
        (TrackingState.RELOCALISED, b'\x01'),
    ],
)
def test_its_level_is_that_of_the_state(node: Node, state: TrackingState, level: bytes) -> None:
    (message,) = published(node, state)
    assert (message.status[0].level, message.status[0].message) == (level, state.value)


def test_nothing_is_made_for_nobody(node: Node) -> None:
    assert not published(node, TrackingState.OK, listeners=0)
