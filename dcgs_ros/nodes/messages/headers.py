# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Integer nanoseconds as ROS's Time and Header."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from ...io.ros_images import MessageError

_SEC_LIMIT = 2**31  # seconds are an int32 on the wire


def time_message(ns: int) -> Time:
    """Nanoseconds as Time; raises `MessageError` beyond the 68 years around zero it can say."""
    sec, nanosec = divmod(int(ns), 1_000_000_000)
    if not -_SEC_LIMIT <= sec < _SEC_LIMIT:
        raise MessageError(f'stamp of {sec} s does not fit 32 bits')
    return Time(sec=sec, nanosec=nanosec)


def header(stamp_ns: int, frame_id: str) -> Header:
    """Header of that instant and frame; raises `MessageError` as `time_message`."""
    return Header(stamp=time_message(stamp_ns), frame_id=frame_id)
