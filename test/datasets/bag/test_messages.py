# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Headers and fields of recorded messages."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('rosbags')

from bags import (  # type: ignore[import-not-found]
    COLOR,
    START_NS,
    Entry,
    color_of,
    image_entry,
)

from dcgs_ros.datasets.bag.messages import EXTRINSICS, decode, read_header, with_stamp
from dcgs_ros.io.ros_images import MessageError


@pytest.mark.parametrize('entry', [image_entry(COLOR, START_NS, 'rgb8', color_of(0))])
def test_a_stamp_is_replaced_and_nothing_else(entry: Entry) -> None:
    assert read_header(entry.cdr) == (START_NS, 'camera_color_optical_frame')
    moved = with_stamp(entry.cdr, 5_000_000_007)
    assert read_header(moved) == (5_000_000_007, 'camera_color_optical_frame')
    assert (moved[:4], moved[12:]) == (entry.cdr[:4], entry.cdr[12:])
    big_endian = b'\0\0\0\0' + bytes([0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0, 2]) + b'a\0'
    assert read_header(big_endian) == (2_000_000_003, 'a')
    assert with_stamp(big_endian, 2_000_000_003) == big_endian


@pytest.mark.parametrize('cdr', [b'', b'\0\1\0\0', b'\0\1\0\0' + bytes(8) + b'\xff' * 8])
def test_what_has_no_header_is_refused(cdr: bytes) -> None:
    with pytest.raises(MessageError, match=f'{len(cdr)} bytes do not begin with a header'):
        read_header(cdr)


def test_extrinsics_of_the_realsense_are_decoded() -> None:
    numbers = np.arange(12.0)
    extrinsics = decode(b'\0\1\0\0' + numbers.tobytes(), EXTRINSICS)
    np.testing.assert_array_equal(extrinsics.rotation, numbers[:9])
    np.testing.assert_array_equal(extrinsics.translation, numbers[9:])


@pytest.mark.parametrize('type_', [EXTRINSICS, 'sensor_msgs/msg/Image', 'no_msgs/msg/Type'])
def test_what_is_no_message_is_refused(type_: str) -> None:
    rng = np.random.default_rng(1)
    for size in (0, 1, 4, 5, 30, 90):
        for head in (b'', b'\0\1\0\0', b'\0\0\0\0'):
            with pytest.raises(MessageError, match=type_):
                decode(head + rng.bytes(size), type_)
