# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Leaves frames out evenly, to save the processor; no ROS in it."""

from __future__ import annotations

_EARLY = 4  # a frame may come by this part of the period before it is due: stamps jitter


class FrameRate:
    """Admits frames by their stamps, at most so many a second in the mean."""

    def __init__(self, max_hz: float) -> None:
        """Take the largest rate, hertz; 0: every frame."""
        self._period_ns = round(1e9 / max_hz) if max_hz > 0 else 0
        self._due_ns: int | None = None
        self.left_out = 0

    def admits(self, stamp_ns: int) -> bool:
        """Return whether to track the frame.

        Each is due a period after the last one was, not after it came: of 30 frames a second, 20
        are two of three. After a gap, or by another clock, that begins anew.
        """
        period_ns, due_ns = self._period_ns, self._due_ns
        if due_ns is None or not -2 * period_ns <= stamp_ns - due_ns <= period_ns:
            due_ns = stamp_ns
        admitted = stamp_ns >= due_ns - period_ns // _EARLY
        self._due_ns = due_ns + period_ns if admitted else due_ns
        self.left_out += not admitted
        return admitted
