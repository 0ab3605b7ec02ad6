# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Ctrl-C and SIGTERM end a run after the frame under way instead of in the middle of it."""

from __future__ import annotations

import signal
import time
from types import FrameType, TracebackType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_PATIENCE_S = 1.0  # launchers and `timeout` send a signal twice in a row


class StopSignals:
    """While this context lasts a first signal is noted; one later than a second after it raises.

    `status` is what the process should exit with: 0, or 128 + the signal's number.
    """

    def __init__(self) -> None:
        """Note nothing yet."""
        self.status = 0
        self._noted_s = 0.0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        """Take the signals over."""
        self._before = {number: signal.signal(number, self._note) for number in _SIGNALS}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Give them back."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        now_s = time.monotonic()
        if self.status == 0:
            self.status, self._noted_s = 128 + number, now_s
        elif now_s - self._noted_s > _PATIENCE_S:
            raise KeyboardInterrupt
