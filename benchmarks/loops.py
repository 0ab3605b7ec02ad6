# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Loops of the back end: `python -m benchmarks.loops [--seeds FIRST LAST] [--only TEXT]`.

Laps of the synthetic ring in both directions, half of them over a floor that repeats itself, and
the corridor there and back; without mapper, the back end between the frames. Prints a Markdown row
for each, and adds a line to `--json FILE`. A loop is wrong if the relative pose of its keyframes
is more than 10 cm or 3 degrees off the truth and beyond the 3 sigma that it claims.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.backend.back_end import BackEnd
from dcgs_ros.core.backend.closure import Closures
from dcgs_ros.core.backend.consistency import Loop
from dcgs_ros.core.backend.features import Features
from dcgs_ros.core.backend.warmup import warm_up
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Keyframe
from dcgs_ros.core.tracking.relocalization import Recogniser
from dcgs_ros.core.tracking.result import TrackResult
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.open import open_source
from dcgs_ros.evaluation.report import FinalMap, RunRecord, TrackedFrame, assess_run
from dcgs_ros.evaluation.trajectory import nearest

LAP = 'synthetic:ring?frames=2150&speed=2&seed={seed}{options}'  # 55 m and a little more
# By turns, as the seeds go on.
LAPS = ('', '&direction=cw&period=2.22', '&period=2.22', '&direction=cw')
CORRIDOR = 'synthetic:corridor?frames=2150&speed=2&seed={seed}'  # 30 m and back
COLUMNS = (
    'source', 'ATE cm live', 'at the end', 'loops', 'wrong', 'not kept', 'of them right',
    'worst cm / deg', 'silent', 'sub-maps', 'ok/degenerate/lost/relocalised', 'keyframes',
    'corrections', 'tracker ms, p99', 'back end ms at most', 's in all', 'at the end s',
)  # fmt: skip
_WRONG_M, _WRONG_RAD = 0.10, math.radians(3)
_SIGMAS = 3.0
_STATES = ('ok', 'degenerate', 'lost', 'relocalised')


class RecordedFinder:
    """Closures that remember what they found."""

    def __init__(self, camera: PinholeCamera, config: Config) -> None:
        """Start without keyframes."""
        self._closures = Closures(camera, config)
        self.found: list[Loop] = []

    @property
    def places(self) -> Recogniser:
        """As `Closures`."""
        return self._closures.places

    def add(
        self,
        keyframe: Keyframe,
        camera: PinholeCamera | None = None,
        features: Features | None = None,
    ) -> None:
        """As `Closures`."""
        self._closures.add(keyframe, camera, features)

    def close(self, keyframe: int) -> Sequence[Loop]:
        """As `Closures`."""
        loops = self._closures.close(keyframe)
        self.found += loops
        return loops


@dataclass(frozen=True)
class Errors:
    """How far loops are from the truth."""

    metres: NDArray[np.float64]  # (L,)
    radians: NDArray[np.float64]  # (L,)
    wrong: NDArray[np.bool_]  # (L,)

    @classmethod
    def of(cls, loops: Sequence[Loop], stamps_ns: NDArray[np.int64], truth: Trajectory) -> Errors:
        """Compare loops between the keyframes with these stamps (K,)."""
        rows = [cls._of_one(loop, stamps_ns, truth) for loop in loops]
        metres, radians, wrong = np.array(rows).reshape(-1, 3).T
        return cls(metres, radians, wrong > 0.0)

    @staticmethod
    def _of_one(
        loop: Loop, stamps_ns: NDArray[np.int64], truth: Trajectory
    ) -> tuple[float, float, bool]:
        (a, b), _ = nearest(stamps_ns[[loop.a, loop.b]], truth.stamps_ns)
        T_a_b = se3.inverse(truth.T_world_cam[a]) @ truth.T_world_cam[b]
        xi = se3.log(se3.inverse(T_a_b) @ loop.T_a_b)
        sizes = [float(np.linalg.norm(part)) for part in (xi[:3], xi[3:])]
        sigmas = [math.sqrt(np.trace(part)) for part in _diagonal_blocks(loop.covariance)]
        limits = zip(sizes, (_WRONG_M, _WRONG_RAD), sigmas, strict=True)
        wrong = any(size > max(limit, _SIGMAS * sigma) for size, limit, sigma in limits)
        return sizes[0], sizes[1], wrong


def _diagonal_blocks(covariance: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    return covariance[:3, :3], covariance[3:, 3:]


@dataclass(frozen=True)
class Score:
    """What came of one lap."""

    source: str
    live_cm: float
    final_cm: float
    loops: int
    wrong: int  # of those that are kept
    not_kept: int
    right_not_kept: int
    worst_cm: float  # of those that are kept
    worst_deg: float
    silent: int
    submaps: int
    states: dict[str, int]
    keyframes: int
    corrections: int
    tracker_ms: tuple[float, float]  # median and 99th percentile
    work_ms: float  # the longest that the back end took for a keyframe
    work_s: float  # in all
    finish_s: float  # the adjustment at the end

    def cells(self) -> list[str]:
        """Return the columns of a row."""
        return [
            self.source, f'{self.live_cm:.1f}', f'{self.final_cm:.1f}', str(self.loops),
            str(self.wrong), str(self.not_kept), str(self.right_not_kept),
            f'{self.worst_cm:.1f} / {self.worst_deg:.1f}', str(self.silent), str(self.submaps),
            '/'.join(str(self.states.get(name, 0)) for name in _STATES), str(self.keyframes),
            str(self.corrections), '{:.1f}, {:.1f}'.format(*self.tracker_ms),
            f'{self.work_ms:.0f}', f'{self.work_s:.1f}', f'{self.finish_s:.1f}',
        ]  # fmt: skip


@dataclass
class Lap:
    """A tracker with the back end between its frames, as `dcgs run` has them."""

    tracker: Tracker
    finder: RecordedFinder
    back_end: BackEnd
    record: RunRecord
    work_s: list[float] = field(default_factory=list)
    track_s: list[float] = field(default_factory=list)

    @classmethod
    def begun(cls, name: str, camera: PinholeCamera, config: Config) -> Lap:
        """Start without a map."""
        tracker, finder = Tracker(camera, config), RecordedFinder(camera, config)
        tracker.recogniser = finder.places
        return cls(tracker, finder, BackEnd(camera, config, finder), RunRecord(name, 'full'))

    def take(self, index: int, frame: RgbdFrame) -> None:
        """Track a frame, and close loops."""
        begin = time.perf_counter()
        result = self.tracker.track(frame)
        seconds = time.perf_counter() - begin
        self.track_s.append(seconds)
        self.record.tracked.append(TrackedFrame(index, replace(result, keyframes=()), seconds, 0))
        if result.keyframes:
            self._close(result)

    def _close(self, result: TrackResult) -> None:
        begin = time.perf_counter()
        for keyframe in result.keyframes:
            self.back_end.add(keyframe)
        correction = self.back_end.work()
        self.work_s.append(time.perf_counter() - begin)
        if correction is not None:
            self.tracker.correct(correction)

    def score(self, truth: Trajectory) -> Score:
        """Adjust what there is at the end, and compare with the truth."""
        begin, tracker = time.perf_counter(), self.tracker
        poses = self.back_end.optimised().T_world_cam
        finish_s = time.perf_counter() - begin
        kept, stamps = self.back_end.loops, np.array(tracker.visited.stamps_ns)
        pairs = [(loop.a, loop.b) for loop in kept]
        submaps = tracker.keyframe_submaps
        self.record.final = FinalMap(poses, tracker.keyframe_poses, submaps, pairs)
        accuracy = assess_run(self.record, truth)
        final = accuracy.optimized
        assert accuracy.ate and accuracy.silent and final and final.ate
        others = [loop for loop in self.finder.found if (loop.a, loop.b) not in set(pairs)]
        believed, left = Errors.of(kept, stamps, truth), Errors.of(others, stamps, truth)
        return Score(
            self.record.source, accuracy.ate.rmse_cm, final.ate.rmse_cm, len(kept),
            int(believed.wrong.sum()), len(others), int((~left.wrong).sum()),
            100 * float(believed.metres.max(initial=0.0)),
            math.degrees(believed.radians.max(initial=0.0)), accuracy.silent.count,
            len(np.unique(submaps)),
            self._states(), tracker.keyframes,
            tracker.revision, self._tracker_ms(), 1e3 * max(self.work_s), sum(self.work_s),
            finish_s,
        )  # fmt: skip

    def _states(self) -> dict[str, int]:
        return dict(Counter(state.value for state in self.record.claims().states))

    def _tracker_ms(self) -> tuple[float, float]:
        median, p99 = (1e3 * np.percentile(self.track_s, [50, 99])).tolist()
        return median, p99


def drive(address: str) -> Score:
    """Track a synthetic sequence with the back end."""
    source = open_source(address)
    assert source.groundtruth is not None
    warm_up(source.camera)
    lap = Lap.begun(source.name, source.camera, Config(sensor=source.sensor))
    for index, frame in enumerate(source):
        assert isinstance(frame, RgbdFrame)
        lap.take(index, frame)
    return lap.score(source.groundtruth)


def addresses(seeds: Sequence[int]) -> Iterator[str]:
    """Yield a lap of the ring for each seed, and then the corridor for each."""
    for seed in seeds:
        yield LAP.format(seed=seed, options=LAPS[seed % len(LAPS)])
    for seed in seeds:
        yield CORRIDOR.format(seed=seed)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, nargs=2, default=(0, 9), metavar=('FIRST', 'LAST'))
    parser.add_argument('--only', default='', metavar='TEXT', help='addresses that contain this')
    parser.add_argument('--json', type=Path, metavar='FILE', help='a line for each row is added')
    arguments = parser.parse_args()
    first, last = arguments.seeds
    print(f'| {" | ".join(COLUMNS)} |\n|{"---|" * len(COLUMNS)}', flush=True)
    for address in addresses(range(first, last + 1)):
        if arguments.only not in address:
            continue
        score = drive(address)
        print(f'| {" | ".join(score.cells())} |', flush=True)
        if arguments.json:
            with arguments.json.open('a') as file:
                file.write(json.dumps(asdict(score)) + '\n')


if __name__ == '__main__':
    main()
