# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A few threads that share out the pieces of a kernel.

Numba's own threads split work evenly in advance; tiles and rows are not even, and another process
may hold a core. Here each thread takes the next piece when it is done with the last. The pieces
are fixed, so results do not depend on how many threads there are.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import count
from typing import Any

PIECES = 16
_LOWEST_PRIORITY = 19  # as `nice` has it


def give_way() -> None:
    """Let every other thread go before the calling one, where priorities are of threads."""
    if sys.platform == 'linux':
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LOWEST_PRIORITY)


def cores() -> int:
    """Count the cores that this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Workers:
    """Runs kernels that release the GIL; the calling thread is one of the workers."""

    def __init__(self, threads: int) -> None:
        """Take `threads` in all, at least 1; they start when they are first needed."""
        self.threads = max(1, threads)
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None

    def run(self, kernel: Callable[..., Any], *arguments: Any, pieces: int = PIECES) -> None:
        """Call `kernel(piece, pieces, *arguments)` once for each piece, in any order."""
        if self._pool is None:
            for piece in range(pieces):
                kernel(piece, pieces, *arguments)
            return
        taken = count()  # next() is atomic

        def work() -> None:
            while (piece := next(taken)) < pieces:
                kernel(piece, pieces, *arguments)

        others = [self._pool.submit(work) for _ in range(self.threads - 1)]
        try:
            work()
        finally:  # nobody writes into the caller's arrays any more when this returns or raises
            started = [other for other in others if not other.cancel()]
            wait(started)
        for other in started:
            other.result()

    def close(self) -> None:
        """Let the threads end; what runs is waited for."""
        if self._pool is not None:
            self._pool.shutdown()
