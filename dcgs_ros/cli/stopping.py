# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Ctrl-C and SIGTERM stop a run after the current frame instead of within it."""

from __future__ import annotations

import signal
import time
from types import FrameType, TracebackType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_PATIENCE_S = 1.0  # launchers and `timeout` send a signal twice in a row


class StopSignals:
    """Context manager that records the first SIGINT or SIGTERM instead of raising.

    `status` is the exit status of the process: 0, or 128 + the signal's number. A signal more
    than a second after the first one raises `KeyboardInterrupt`.
    """

    def __init__(self) -> None:
        """Start without a signal."""
        self.status = 0
        self._first_s = 0.0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        """Install the handlers."""
        self._before = {number: signal.signal(number, self._handle) for number in _SIGNALS}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Restore the previous handlers."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        now_s = time.monotonic()
        if self.status == 0:
            self.status, self._first_s = 128 + number, now_s
        elif now_s - self._first_s > _PATIENCE_S:
            raise KeyboardInterrupt
