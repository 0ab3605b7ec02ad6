# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The executables of the nodes: a signal ends them quietly while they are still being imported.

Nothing else of the package is imported before the signals are handled: it takes seconds.
"""

from __future__ import annotations

import os
import signal
from importlib import import_module
from types import FrameType


def tracker() -> int:
    """Run the tracker until it is told to stop."""
    return _run('tracker')


def mapper() -> int:
    """Run the mapper until it is told to stop."""
    return _run('mapper')


def replay() -> int:
    """Replay to the end, or until told to stop."""
    return _run('replay')


def _run(name: str) -> int:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    status: int = import_module(f'.{name}', __package__).main()
    return status


def _leave(number: int, frame: FrameType | None) -> None:
    """End the process as a node ends that is told to, whose own handlers replace this one."""
    os._exit(0)
