# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A playback does not run away from the tracker, and does not wait for one that says nothing."""

from __future__ import annotations

import threading
import time

from dcgs_ros.nodes.playback.pursuit import Pursuit

HANGS_S = 60.0  # only a failure takes so long


def test_no_more_frames_are_ahead_than_allowed_however_slow_the_tracker() -> None:
    pursuit, most, waiting = Pursuit(3, HANGS_S), 0, list[int]()

    def track() -> None:
        for _ in range(50):
            while not waiting:
                time.sleep(1e-4)
            pursuit.tracked(waiting.pop(0))

    thread = threading.Thread(target=track)
    thread.start()
    for stamp in range(50):
        assert pursuit.wait()
        pursuit.played(stamp)
        waiting.append(stamp)
        most = max(most, len(waiting))
    thread.join(HANGS_S)
    assert most <= 3 and not thread.is_alive()


def test_what_never_becomes_a_pair_is_done_with_the_next_that_does() -> None:
    pursuit = Pursuit(4, 0.0)
    for stamp in (7, 8, 9):
        pursuit.played(stamp)
    pursuit.tracked(8)
    pursuit.tracked(5)  # of another recording
    for stamp in (1, 2):  # the recording begins again
        assert pursuit.wait()
        pursuit.played(stamp)
    pursuit.tracked(2)
    assert pursuit.wait()


def test_a_tracker_that_says_nothing_is_waited_for_ever_more_seldom() -> None:
    pursuit = Pursuit(2, 0.0)
    waits = 0
    for stamp in range(500):
        waits += not pursuit.wait()
        pursuit.played(stamp)
    assert 5 < waits < 10


def test_the_end_of_the_playback_ends_the_wait() -> None:
    pursuit = Pursuit(1, HANGS_S)
    pursuit.played(1)
    threading.Timer(0.05, pursuit.end).start()
    start_s = time.monotonic()
    assert pursuit.wait() and time.monotonic() - start_s < HANGS_S / 2
