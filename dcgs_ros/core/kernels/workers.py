# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A pool of threads that run the pieces of a kernel.

Numba's own threads split work evenly in advance, but tiles and rows differ in cost, and another
process may occupy a core. Here each thread takes the next piece when it has finished the last. The
pieces are fixed, so that results do not depend on the number of threads.
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
_LOWEST_PRIORITY = 19  # of `nice`


def give_way(nice: int = _LOWEST_PRIORITY) -> None:
    """Lower the priority of the calling thread (on Linux, where threads have priorities).

    It keeps a lower one that it has already: only root may raise it.
    """
    if sys.platform == 'linux':
        thread = threading.get_native_id()
        now = os.getpriority(os.PRIO_PROCESS, thread)
        os.setpriority(os.PRIO_PROCESS, thread, max(now, nice))


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Workers:
    """Runs kernels that release the GIL, in the calling thread and some others."""

    def __init__(self, threads: int) -> None:
        """Use `threads` threads, at least 1, the caller's included; they start on first use."""
        self.threads = max(1, threads)
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None

    def run(self, kernel: Callable[..., Any], *arguments: Any, pieces: int = PIECES) -> None:
        """Call `kernel(piece, pieces, *arguments)` once for each piece, in any order; wait."""
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
        finally:  # no thread may write into the caller's arrays once this returns or raises
            started = [other for other in others if not other.cancel()]
            wait(started)
        for other in started:
            other.result()

    def close(self) -> None:
        """End the threads, after the work that is running."""
        if self._pool is not None:
            self._pool.shutdown()
