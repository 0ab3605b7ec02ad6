# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A long walk through known rooms: `python -m benchmarks.long_walk SOURCE [--laps N]`.

Plays a recording that ends where it begins again and again, at the pace of its stamps, to a
tracker with the back end in its thread, as `dcgs run --online --no-mapping` has them. A row for
each lap: the memory that the process holds, what there is in it, and the tracker's milliseconds.
A lap of 55 m is made by `dcgs convert 'synthetic:ring?frames=1862&speed=2&seed=2' SOURCE`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core.backend.places import Places
from dcgs_ros.core.backend.warmup import warm_up
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Correction
from dcgs_ros.core.loop_closing import ClosingMode, ClosingOnline, NoClosing
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import Source
from dcgs_ros.evaluation.host import machine, rss_mb
from dcgs_ros.evaluation.trajectory import absolute_trajectory_error

COLUMNS = (
    'lap', 'MB', 'Gaussians', 'landmarks', 'keyframes', 'views kept', 'loops', 'corrections',
    'lost', 'ATE cm', 'tracker ms', 'p99',
)  # fmt: skip


class _NoMap:
    def correct(self, correction: Correction) -> None:
        """Ignore the correction."""


@dataclass
class Lap:
    """What came of the frames of a lap."""

    results: list[TrackResult]
    seconds: list[float]  # in the tracker and in the exchange with the back end

    def ate_cm(self, truth: Trajectory, shift_ns: int) -> float:
        """Return the error of the poses as known live, in an alignment of this lap."""
        found = [r for r in self.results if r.state is not TrackingState.LOST]
        stamps_ns = np.array([result.stamp_ns - shift_ns for result in found], np.int64)
        poses = Trajectory(stamps_ns, np.array([result.T_world_cam for result in found]))
        return absolute_trajectory_error(poses, truth).rmse_cm

    @property
    def lost(self) -> int:
        """Frames without a pose."""
        return sum(result.state is TrackingState.LOST for result in self.results)


def at_pace(source: Source, shift_ns: int, begin_s: float) -> Iterator[RgbdFrame]:
    """Yield the frames later by `shift_ns`, not before their time since `begin_s`."""
    first_ns: int | None = None
    for frame in source:
        assert isinstance(frame, RgbdFrame)
        first_ns = frame.stamp_ns if first_ns is None else first_ns
        due_s = begin_s + (frame.stamp_ns - first_ns) * 1e-9
        time.sleep(max(due_s - time.perf_counter(), 0.0))
        stamp_ns, depth_stamp_ns = frame.stamp_ns + shift_ns, frame.depth_stamp_ns + shift_ns
        yield replace(frame, stamp_ns=stamp_ns, depth_stamp_ns=depth_stamp_ns)


def drive(source: Source, shift_ns: int, tracker: Tracker, closing: ClosingMode) -> Lap:
    """Drive one lap."""
    lap = Lap([], [])
    for frame in at_pace(source, shift_ns, time.perf_counter()):
        begin = time.perf_counter()
        result = tracker.track(frame)
        closing.after(result)
        lap.seconds.append(time.perf_counter() - begin)
        lap.results.append(replace(result, keyframes=()))
    return lap


def period_ns(stamps_ns: NDArray[np.int64]) -> int:
    """Return after how long the frames come again: one interval after the last."""
    intervals = np.diff(stamps_ns)
    return int(stamps_ns[-1] - stamps_ns[0] + np.median(intervals))


def rows(address: str, laps: int, loops: bool) -> Iterator[list[str]]:
    """Yield the cells of a row for each lap."""
    source = open_source(address)
    truth = source.groundtruth
    assert truth is not None
    warm_up(source.camera)
    tracker = Tracker(source.camera, Config(sensor=source.sensor))
    closing: ClosingMode = NoClosing()
    if loops:
        closing = ClosingOnline(tracker, _NoMap())  # type: ignore[arg-type]
    period = period_ns(truth.stamps_ns)
    for number in range(laps):
        lap = drive(source, number * period, tracker, closing)
        median_ms, p99_ms = (1e3 * np.percentile(lap.seconds, [50, 99])).tolist()
        places = tracker.recogniser
        yield [
            str(number + 1), f'{rss_mb():.0f}', str(len(tracker.gaussians)),
            str(len(tracker.landmarks)), str(tracker.keyframes),
            str(len(places)) if isinstance(places, Places) else '-', str(len(closing.loops)),
            str(tracker.revision), str(lap.lost), f'{lap.ate_cm(truth, number * period):.1f}',
            f'{median_ms:.1f}', f'{p99_ms:.1f}',
        ]  # fmt: skip
    begin = time.perf_counter()
    closing.finish()
    print(f'\nAfter the last frame: {time.perf_counter() - begin:.1f} s')


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('source')
    parser.add_argument('--laps', type=int, default=10)
    parser.add_argument('--no-loops', action='store_true', help='the tracker alone')
    arguments = parser.parse_args()
    print(f'{machine()}\n\n| {" | ".join(COLUMNS)} |\n|{"---|" * len(COLUMNS)}', flush=True)
    for cells in rows(arguments.source, arguments.laps, not arguments.no_loops):
        print(f'| {" | ".join(cells)} |', flush=True)


if __name__ == '__main__':
    main()
