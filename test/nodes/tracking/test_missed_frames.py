# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How many frames came before anybody could use them."""

from __future__ import annotations

from dcgs_ros.nodes.tracking.missed_frames import MissedFrames

FRAME_NS = 33_333_333


def missed(*indices: int) -> MissedFrames:
    frames = MissedFrames()
    for index in indices:
        frames.add(10**18 + index * FRAME_NS)
    return frames


def test_frames_are_counted_with_the_time_that_they_span() -> None:
    frames = missed(*range(784))
    assert frames.count == 784
    assert str(frames).startswith('missed 784 frames (26.1 s)')


def test_those_from_the_first_image_on_are_not_missed() -> None:
    frames = missed(*range(20))
    frames.end(10**18 + 17 * FRAME_NS)
    assert frames.count == 17 and '17 frames (0.5 s)' in str(frames)
    frames = missed(3)
    frames.end(10**18)
    assert frames.count == 0


def test_a_calibration_that_is_repeated_is_no_frame() -> None:
    assert missed(0, 0, 0).count == 1


def test_a_recording_that_is_played_again_counts_again() -> None:
    assert missed(0, 1, 2, 0, 1, 2).count == 6
