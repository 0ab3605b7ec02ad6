# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How a node is doing, as /diagnostics and its log show it; no ROS in it."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from enum import IntEnum

_NUMBER_OR_NAME = re.compile(
    r"""\([^)]*\)|'[^']*'|"[^"]*"|-?\b(\d+(\.\d+)?(e[-+]?\d+)?|inf|nan)\b"""
)
_FORGOTTEN_S = 60.0  # after which a cause that comes again is another one
_PAUSE_S, _LONGEST_S = 5.0, 60.0  # between messages that begin alike: ever longer
_KINDS = 8  # of messages that begin alike and are told apart


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
PAUSED = Verdict(Level.WARN, 'paused: images are ignored until ~/resume is called', logged=True)


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
    """Holds back messages that repeat, ever longer: none hides one of another kind."""

    def __init__(self) -> None:
        """Start with nothing said."""
        self._said: dict[str, set[str]] = {}  # kinds, by how a message begins
        self._due: dict[str, tuple[float, float]] = {}  # by how it begins: when, and after what

    def admits(self, text: str) -> bool:
        """Return whether to say it: for the first time, or seconds after one that began alike."""
        kind, now = _kind(text), time.monotonic()
        begins = kind.partition(':')[0]
        said = self._said.setdefault(begins, set())
        known = kind in said or len(said) >= _KINDS
        due_s, pause_s = self._due.get(begins, (now, 0.0))
        if known and now < due_s:
            return False
        lasts = known and now < due_s + pause_s
        pause_s = min(2.0 * pause_s, _LONGEST_S) if lasts else _PAUSE_S
        said.add(kind)
        self._due[begins] = now + pause_s, pause_s
        return True


def _kind(text: str) -> str:
    """Return a message without its numbers and names."""
    return _NUMBER_OR_NAME.sub('#', text)
