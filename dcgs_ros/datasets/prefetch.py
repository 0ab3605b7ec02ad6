# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Decoding ahead of use, in a thread: decoding a pair of PNGs takes longer than tracking it."""

from __future__ import annotations

import queue
import threading
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import TypeVar

from ..core.frame import RgbdFrame
from ..core.kernels.jit import set_kernel_threads
from ..core.kernels.workers import give_way
from .source import BadFrame, Source

Item = TypeVar('Item')


@dataclass(frozen=True)
class _End:
    """The last entry of the queue."""

    error: BaseException | None


def prefetch(source: Iterable[Item], depth: int = 4) -> Generator[Item, None, None]:
    """Iterate over `source` in a background thread, at most `depth` items ahead, in its order.

    An exception of the source is raised here, after the items before it. The thread starts when
    the first item is requested and ends with this generator, also when that is closed early: wrap
    it in `contextlib.closing` if an exception may leave the loop.
    """
    if depth < 1:
        raise ValueError(f'depth must be at least 1, got {depth}')
    items: queue.Queue[Item | _End] = queue.Queue(maxsize=depth)
    stop = threading.Event()

    def produce() -> None:
        error: BaseException | None = None
        try:
            for item in source:
                items.put(item)
                if stop.is_set():
                    return
        except BaseException as caught:  # of any kind: it is raised again in the consumer
            error = caught
        items.put(_End(error))

    thread = threading.Thread(target=produce, name='prefetch', daemon=True)
    thread.start()
    try:
        while not isinstance(item := items.get(), _End):
            yield item
        if item.error is not None:
            raise item.error
    finally:
        stop.set()
        # A drained queue has room for the item the thread may still hold before it checks `stop`.
        while not items.empty():
            items.get_nowait()
        thread.join()


def prefetch_frames(
    source: Source, total: int, quietly: bool
) -> Generator[RgbdFrame | BadFrame, None, None]:
    """Prefetch the first `total` frames; with `quietly` in a thread of the lowest priority.

    At equal priority decoding costs the tracker a third of its speed on two cores (measured). An
    online run cannot use it, as decoding must keep up while the mapper takes all spare time. The
    kernels of a synthetic source leave one core free in either case.
    """

    def frames() -> Iterator[RgbdFrame | BadFrame]:
        set_kernel_threads(None)
        if quietly:
            give_way()
        yield from islice(source, total)

    return prefetch(frames())
