# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How a node is doing, as /diagnostics and its log show it; no ROS in it."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from enum import IntEnum

_NUMBER_OR_NAME = re.compile(r"-?\d+(\.\d+)?|'[^']*'|\"[^\"]*\"")
_FORGOTTEN_S = 60.0  # after which a cause that comes again is another one
_PAUSE_S = 5.0  # between messages that begin alike
_KINDS = 100  # of messages that are told apart


class Level(IntEnum):
    """The levels of DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Verdict:
    """A level and its reason."""

    level: Level
    message: str
    logged: bool = False  # as an event, when it happened


LOADING = Verdict(
    Level.WARN, 'loading the kernels: a minute the first time, else seconds', logged=True
)


class News:
    """Tells of each cause once while it lasts, whatever its numbers."""

    def __init__(self) -> None:
        """Start without any."""
        self._seen_s: dict[str, float] = {}  # monotonic time by cause
        self._told: set[str] = set()

    def is_new(self, text: str) -> bool:
        """Return whether to tell of a cause: the second time that it is seen within a minute."""
        cause, now = _kind(text), time.monotonic()
        last_s, self._seen_s[cause] = self._seen_s.get(cause), now
        if last_s is None or now - last_s > _FORGOTTEN_S:
            self._told.discard(cause)
            return False
        if cause in self._told:
            return False
        self._told.add(cause)
        return True


class Throttle:
    """Holds back messages that repeat, each for itself: none hides one of another kind."""

    def __init__(self) -> None:
        """Start with nothing said."""
        self._said: set[str] = set()
        self._due_s: dict[str, float] = {}  # monotonic time by how a message begins

    def admits(self, text: str) -> bool:
        """Return whether to say it: for the first time, or seconds after one that began alike."""
        kind, now = _kind(text), time.monotonic()
        begins = kind.partition(':')[0]
        known = kind in self._said or len(self._said) >= _KINDS
        if known and now < self._due_s.get(begins, now):
            return False
        self._said.add(kind)
        self._due_s[begins] = now + _PAUSE_S
        return True


def _kind(text: str) -> str:
    """Return a message without its numbers and names."""
    return _NUMBER_OR_NAME.sub('#', text)
