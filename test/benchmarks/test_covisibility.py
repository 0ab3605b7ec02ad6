# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What has been seen before: before a wall, and behind it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.covisibility import share_seen
from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame

CAMERA = PinholeCamera(640, 480, 500.0, 500.0, 319.5, 239.5)
HERE = np.eye(4)


def wall(depth_m: float) -> RgbdFrame:
    """A wall across the optical axis."""
    return RgbdFrame(
        0, 0, np.zeros((480, 640), np.uint8), np.full((480, 640), depth_m, np.float32)
    )


def aside(metres: float) -> NDArray[np.float64]:
    return se3.exp(np.array([metres, 0, 0, 0, 0, 0]))


def test_a_view_has_seen_itself_and_nothing_is_seen_before_the_first() -> None:
    assert share_seen((wall(2.0), HERE), [(wall(2.0), HERE)], CAMERA) == 1.0
    assert share_seen((wall(2.0), HERE), [], CAMERA) == 0.0


@pytest.mark.parametrize('share', [0.25, 0.5, 1.0])
def test_a_step_aside_leaves_as_much_as_stays_in_view(share: float) -> None:
    """The image is 640 / 500 times as wide as the wall is far."""
    step_m = (1 - share) * 2.0 * 640 / 500
    found = share_seen((wall(2.0), aside(step_m)), [(wall(2.0), HERE)], CAMERA)
    assert found == pytest.approx(share, abs=0.04)


def test_two_earlier_views_have_seen_what_either_has() -> None:
    both = [(wall(2.0), aside(-1.28)), (wall(2.0), aside(1.28))]
    assert share_seen((wall(2.0), HERE), both[:1], CAMERA) == pytest.approx(0.5, abs=0.04)
    assert share_seen((wall(2.0), HERE), both, CAMERA) == pytest.approx(1.0, abs=0.04)


def test_what_was_hidden_has_not_been_seen() -> None:
    assert share_seen((wall(3.0), HERE), [(wall(2.0), HERE)], CAMERA) == 0.0


def test_what_is_behind_the_camera_has_not_been_seen() -> None:
    back = se3.exp(np.array([0, 0, 0, 0, np.pi - 1e-6, 0]))
    assert share_seen((wall(2.0), back), [(wall(2.0), HERE)], CAMERA) == 0.0
