# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How far a playback is ahead of the tracker that it plays to; no ROS in it."""

from __future__ import annotations

import threading
from collections import deque


class Pursuit:
    """Lets a playback be a few frames ahead of a tracker, which tells what it is through with."""

    def __init__(self, frames: int, patience_s: float) -> None:
        """Allow so many frames, and twice as many whenever the tracker was silent so long."""
        self._frames, self._patience_s = frames, patience_s
        self._ahead: deque[int] = deque()  # stamps, in the order of playing
        self._ended = False
        self._changed = threading.Condition()

    def played(self, stamp_ns: int) -> None:
        """Take the stamp of a frame that was played."""
        with self._changed:
            self._ahead.append(stamp_ns)

    def tracked(self, stamp_ns: int) -> None:
        """Take the stamp of a frame that the tracker is through with; so are those before it."""
        with self._changed:
            while stamp_ns in self._ahead:
                self._ahead.popleft()
            self._changed.notify()

    def wait(self) -> bool:
        """Wait until another frame may be played; return False where the tracker was silent.

        It may have died, or lack depth, which may be recorded much later than colour.
        """
        with self._changed:
            if self._changed.wait_for(self._may_play, self._patience_s):
                return True
            self._frames *= 2
            self._ahead.clear()
            return False

    def end(self) -> None:
        """Wait no more."""
        with self._changed:
            self._ended = True
            self._changed.notify()

    def _may_play(self) -> bool:
        return self._ended or len(self._ahead) < self._frames
