# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Speed of the tracker: `python -m benchmarks.tracking [SOURCE] [--repeats 3]`.

Frames are in memory; a time is one call of `Tracker.track`, keyframes included. Two tables: by
threads and by the size of the map. The rows of a table are measured in turns, frame by frame, so
that changes of the machine's speed affect all of them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels.jit import set_threads
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import Source

_WARM_UP = 5  # frames that are not timed: the second one rebuilds the map
_MAP_SIZES = (50_000, 100_000, 200_000, 500_000)


def _pad_map(tracker: Tracker, size: int) -> None:
    """Add shifted copies of the map until it has `size` Gaussians, like rooms of a building."""
    gaussians = tracker.gaussians
    means, normals = gaussians.means.copy(), gaussians.normals.copy()
    flatness = gaussians.flatness.copy()
    span = means.max(axis=0) - means.min(axis=0) + 0.5
    cell = 0
    while len(gaussians) < size:
        cell += 1
        shift = span * np.array([cell % 8, cell // 8 % 8, cell // 64], np.float32)
        n = min(len(means), size - len(gaussians))
        moved = (means[:n] + shift).astype(np.float32)
        gaussians.add(moved, normals[:n], flatness[:n], shift, 0)


def interleaved(
    source: Source, frames: Sequence[RgbdFrame], threads: Sequence[int], sizes: Sequence[int]
) -> NDArray[np.float64]:
    """Return milliseconds (rows, frames) of trackers that take turns on the same frames."""
    trackers = [Tracker(source.camera, Config(sensor=source.sensor)) for _ in threads]
    times = np.zeros((len(trackers), len(frames)))
    for k, frame in enumerate(frames):
        for row, tracker in enumerate(trackers):
            set_threads(threads[row])
            start = time.perf_counter()
            tracker.track(frame)
            times[row, k] = 1e3 * (time.perf_counter() - start)
            if k == _WARM_UP - 1 and sizes[row]:
                _pad_map(tracker, sizes[row])
    return times[:, _WARM_UP:]


def _table(names: Sequence[str], times: NDArray[np.float64]) -> None:
    print(f'{"":16s}  fps mean  median ms    p95    p99  mean ratio')
    for name, row in zip(names, times, strict=True):
        median, p95, p99 = np.percentile(row, [50, 95, 99])
        ratio = row.mean() / times[0].mean()
        print(
            f'{name:16s} {1e3 / row.mean():9.0f} {median:10.2f} '
            f'{p95:6.2f} {p99:6.2f} {ratio:11.2f}'
        )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('source', nargs='?', default='synthetic:room')
    parser.add_argument('--repeats', type=int, default=3)
    arguments = parser.parse_args()
    source = open_source(arguments.source)
    frames = [frame for frame in source if isinstance(frame, RgbdFrame)]
    interleaved(source, frames[:10], [1, 2], [0, 0])  # compile
    for title, names, threads, sizes in (
        ('threads', ['1 thread', '2 threads'], [1, 2], [0, 0]),
        (
            'map size, 1 thread',
            [f'{size} Gaussians' for size in _MAP_SIZES],
            [1] * len(_MAP_SIZES),
            _MAP_SIZES,
        ),
    ):
        print(f'\n{source.name}, {title}: medians of {arguments.repeats} runs')
        runs = [interleaved(source, frames, threads, sizes) for _ in range(arguments.repeats)]
        _table(names, np.median(runs, axis=0))


if __name__ == '__main__':
    main()
