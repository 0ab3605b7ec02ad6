# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What can be an RGB-D frame, and what cannot."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.errors import DcgsError, FrameError
from dcgs_ros.core.frame import RgbdFrame


def color(*shape: int, dtype: type = np.uint8) -> NDArray[Any]:
    return np.zeros(shape, dtype)


def depth(*shape: int, dtype: type = np.float32) -> NDArray[Any]:
    return np.ones(shape, dtype)


@pytest.mark.parametrize('shape', [(48, 64), (48, 64, 3)])
def test_grey_and_color_are_frames(shape: tuple[int, ...]) -> None:
    frame = RgbdFrame(5, 7, color(*shape), depth(48, 64))
    assert (frame.stamp_ns, frame.depth_stamp_ns) == (5, 7)


def test_one_measurement_is_enough() -> None:
    depth_m = np.zeros((48, 64), np.float32)
    depth_m[3, 4] = 1.0
    RgbdFrame(0, 0, color(48, 64), depth_m)


@pytest.mark.parametrize(
    ('image', 'depth_m', 'named'),
    [
        (color(48, 64, 4), depth(48, 64), r'48, 64, 4'),
        (color(48, 64, 1), depth(48, 64), r'48, 64, 1'),
        (color(48, 64, 3, 1), depth(48, 64), 'colour is'),
        (color(48), depth(48, 64), 'colour'),
        (color(48, 64, dtype=np.uint16), depth(48, 64), 'uint16'),
        (color(48, 64, dtype=np.float32), depth(48, 64), 'float32'),
        (color(48, 64), depth(48, 64, dtype=np.uint16), 'uint16'),
        (color(48, 64), depth(48, 64, dtype=np.float64), 'float64'),
        (color(48, 64), depth(48, 64, 1), r'48, 64, 1'),
        (color(48, 64), depth(64, 48), '64x48 but depth 48x64'),
        (color(24, 32, 3), depth(48, 64), '32x24 but depth 64x48'),
        (color(48, 64), 0 * depth(48, 64), 'zero'),
        (color(48, 64), -depth(48, 64), 'zero'),
        (color(48, 64), np.nan * depth(48, 64), 'zero'),
        (color(0, 0), depth(0, 0), 'zero'),
    ],
)
def test_what_is_no_frame_is_refused(
    image: NDArray[Any], depth_m: NDArray[Any], named: str
) -> None:
    with pytest.raises(FrameError, match=named):
        RgbdFrame(0, 0, image, depth_m)


def test_a_bad_frame_is_an_error_of_the_package() -> None:
    assert issubclass(FrameError, DcgsError)
