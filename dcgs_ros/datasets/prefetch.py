# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Decoding ahead of use: a PNG pair takes longer to decode than a frame to track."""

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

    An exception of the source is raised here, after the items that came before it. The thread
    starts with the first item asked for and has ended when this generator has, closed early or
    not: wrap it in `contextlib.closing` where the loop may be left by an exception.
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
        except BaseException as caught:  # the consumer's to handle, whatever it is
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
        # Once drained, the queue takes whatever the thread still holds before it looks at `stop`.
        while not items.empty():
            items.get_nowait()
        thread.join()


def prefetch_frames(
    source: Source, total: int, quietly: bool
) -> Generator[RgbdFrame | BadFrame, None, None]:
    """Prefetch the first `total` frames; `quietly` in a thread that gives way to all others.

    At equal priority decoding costs the tracker a third of its speed on two cores (measured). But
    it has to keep up with the clock online, where the mapper takes whatever is left of them. A
    synthetic source's kernels may not take all the cores either.
    """

    def frames() -> Iterator[RgbdFrame | BadFrame]:
        set_kernel_threads(None)
        if quietly:
            give_way()
        yield from islice(source, total)

    return prefetch(frames())
