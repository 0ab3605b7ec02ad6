# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How much of a camera, or of a recording, went by before the tracker could use it."""

from __future__ import annotations

from collections import deque

_ON_THEIR_WAY = 32  # frames of which camera_info has come and the image has not


class MissedFrames:
    """Frames whose images nobody was subscribed to yet, as their camera_infos tell."""

    def __init__(self) -> None:
        """Start without any."""
        self.count = 0
        self.told = False
        self._first_ns = 0
        self._latest_ns: deque[int] = deque(maxlen=_ON_THEIR_WAY)

    def add(self, stamp_ns: int) -> None:
        """Count a frame by its stamp; one that comes again at once is the same."""
        if self._latest_ns and stamp_ns == self._latest_ns[-1]:
            return
        if not self.count:
            self._first_ns = stamp_ns
        self._latest_ns.append(stamp_ns)
        self.count += 1

    def end(self, stamp_ns: int) -> None:
        """Take the stamp of the first image: it and those after it are not missed."""
        while self._latest_ns and self._latest_ns[-1] >= stamp_ns:
            self._latest_ns.pop()
            self.count -= 1

    def __str__(self) -> str:
        """Say how many there are and what to do."""
        span_s = (self._latest_ns[-1] - self._first_ns) * 1e-9 if self._latest_ns else 0.0
        return (
            f'missed {self.count} frames ({span_s:.1f} s) that came before the tracker was ready: '
            "play a recording from its start once 'ready' is logged"
        )
