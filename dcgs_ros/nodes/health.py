# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How a node is doing, as /diagnostics shows it; no ROS in it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


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


LOADING = Verdict(Level.WARN, 'loading the kernels: a minute the first time, else seconds')
