# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Nanoseconds in a Header: exact, or refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip('rclpy')

from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from dcgs_ros.io.ros_images import MessageError, stamp_ns
from dcgs_ros.nodes.messages.standard import header, time_message

EARLIEST_NS = -(2**31) * 10**9
LATEST_NS = 2**31 * 10**9 - 1


@given(st.integers(EARLIEST_NS, LATEST_NS) | st.sampled_from([EARLIEST_NS, -1, 0, LATEST_NS]))
def test_a_stamp_survives_the_wire(ns: int) -> None:
    sent = header(ns, 'camera')
    got = deserialize_message(serialize_message(sent), Header)
    assert stamp_ns(got.stamp) == ns
    assert 0 <= got.stamp.nanosec < 10**9
    assert got.frame_id == 'camera'


@pytest.mark.parametrize('ns', [EARLIEST_NS - 1, LATEST_NS + 1, 2**62])
def test_a_stamp_beyond_32_bits_of_seconds_is_refused(ns: int) -> None:
    with pytest.raises(MessageError, match=f'{ns // 10**9} s does not fit'):
        time_message(ns)
