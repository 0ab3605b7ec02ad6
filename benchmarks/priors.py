# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What gyro and wheels add: `python -m benchmarks.priors [--only TEXT] [--seeds 2 3 4]`.

Each scene is tracked without them and with them: a bare corridor with wheels that slip or
not, turns on the spot at 3 rad/s with a covered lens, and a hand-held camera at 2.5 times the
usual speed, and 70 m of a robot that stops and turns on the spot. Drift is at the end of the way,
from its beginning, without any alignment; height and tilt are the most on the way.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.cli.run.pipeline import NoMapping
from dcgs_ros.core import se3
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.loop_closing import ClosingInLockstep, ClosingMode, NoClosing
from dcgs_ros.core.priors.readings import AngularRate, BasePose, Reading
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.readings import Readings, priors_of
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.evaluation.report import RunRecord, TrackedFrame, assess_run

_COVERED_DEPTH_M, _COVERED_SHARE = (0.3, 0.5), 0.05  # noise near the camera
_BIAS = 0.02 * np.array([1.0, -1.0, 1.0]) / np.sqrt(3.0)  # rad/s, added to the gyro's own


@dataclass(frozen=True)
class Variant:
    """The sensors that a scene is tracked with."""

    name: str
    settings: Mapping[str, object]
    slip: float = 0.0  # share by which the wheels turn too far


@dataclass(frozen=True)
class Case:
    """A scene with what is done to it, and what it is tracked with."""

    name: str
    address: str  # without the seed
    variants: tuple[Variant, ...]
    covered: tuple[int, int] = (0, 0)  # frames in which the lens is
    every: int = 1  # which frames are tracked, of 30 a second


_GYRO, _WHEELS = {'priors.gyro': True}, {'priors.wheels': True}
_ALONE, _WITH_GYRO = Variant('alone', {}), Variant('gyro', _GYRO)
_FLOOR = {**_GYRO, **_WHEELS, 'priors.planar_m': 0.003}
_AHEAD = {'backend.loops': False}  # the way is gone once
_CORRIDOR = (
    Variant('alone', _AHEAD), Variant('wheels', _AHEAD | _WHEELS),
    Variant('wheels + gyro', _AHEAD | _WHEELS | _GYRO),
    Variant('both, slip of 5 %', _AHEAD | _WHEELS | _GYRO, 0.05),
)  # fmt: skip
_ERRAND = (
    Variant('alone', _AHEAD), Variant('both, floor', {**_AHEAD, **_FLOOR}),
    Variant('both, floor, loops', _FLOOR),
)  # fmt: skip
_LEVEL = tuple(
    Variant(name, _AHEAD | _WHEELS | {f'priors.{name}': True}) for name in ('gyro', 'gravity')
)
CASES = (
    Case('corridor of 28 m', 'corridor?frames=940&speed=2', _CORRIDOR),
    Case('errand of 70 m', 'ring?motion=errand&frames=4880', _ERRAND, every=2),
    Case(
        'turns, 2 s covered', 'room?motion=turning&sensor=d435i_measured&frames=400',
        (_ALONE, _WITH_GYRO), (215, 275),
    ),
    Case('tilt, 18 m of it', 'corridor?frames=600&speed=2', _LEVEL),
    Case('fast, d435i_measured', 'room?sensor=d435i_measured&speed=2.5', (_ALONE, _WITH_GYRO)),
    Case('fast, d435i', 'room?sensor=d435i&speed=2.5', (_ALONE, _WITH_GYRO)),
    Case('fast, kinect', 'room?speed=2.5', (_ALONE, _WITH_GYRO)),
)  # fmt: skip


def covered(frame: RgbdFrame, seed: int) -> RgbdFrame:
    """Return a frame of a lens that something covers."""
    rng = np.random.default_rng((seed, frame.stamp_ns))
    depth_m = rng.uniform(*_COVERED_DEPTH_M, frame.depth_m.shape).astype(np.float32)
    depth_m[rng.random(depth_m.shape) >= _COVERED_SHARE] = 0.0
    color = rng.integers(0, 4, frame.color.shape, np.uint8)
    return replace(frame, color=color, depth_m=depth_m)


class Spoiler:
    """Adds a bias to rates, and slip to the way of the wheels."""

    def __init__(self, slip: float) -> None:
        """Begin where the wheels begin."""
        self._slip, self._last, self._T = slip, np.eye(4), np.eye(4)

    def __call__(self, reading: Reading) -> Reading:
        """Return the next reading, spoilt."""
        if isinstance(reading, AngularRate):
            return replace(reading, rate=reading.rate + _BIAS)
        if not isinstance(reading, BasePose):
            return reading
        step = se3.log(se3.inverse(self._last) @ reading.T_odom_base)
        step[:3] *= 1.0 + self._slip
        self._last, self._T = reading.T_odom_base, self._T @ se3.exp(step)
        return replace(reading, T_odom_base=self._T)


class Run:
    """One tracker, and what came of it."""

    def __init__(self, source: SyntheticSource, variant: Variant) -> None:
        """Begin before the first frame."""
        self.variant = variant
        config = override(Config(sensor=source.sensor), variant.settings)
        priors = priors_of(source, config.priors)
        self._tracker = Tracker(source.camera, config, priors=priors)
        closing: ClosingMode = NoClosing()
        if config.backend.loops:
            closing = ClosingInLockstep(self._tracker, NoMapping())
        self._closing = closing
        self._readings, self._spoilt = Readings(source, config.priors), Spoiler(variant.slip)
        self.record, self._gyro = RunRecord(source.name, config.ablation), priors.gyro
        self.bias_rad_s: list[NDArray[np.float64]] = []

    def track(self, index: int, frame: RgbdFrame) -> None:
        """Track one frame."""
        for reading in self._readings.until(frame.stamp_ns):
            self._tracker.sense(self._spoilt(reading))
        result = self._tracker.track(frame)
        self._closing.after(result)
        self._closing.advance()
        self.record.tracked.append(TrackedFrame(index, result, 0.0, 0))
        if self._gyro is not None:
            self.bias_rad_s.append(self._gyro.bias)


def rows(case: Case, seed: int) -> Iterator[str]:
    """Track a case, each frame with all variants, as rendering takes longer; yield their rows."""
    source = SyntheticSource.from_address(f'synthetic:{case.address}&seed={seed}')
    runs = [Run(source, variant) for variant in case.variants]
    for index, frame in _frames(source, case.every):
        shown = covered(frame, seed) if case.covered[0] <= index < case.covered[1] else frame
        for run in runs:
            run.track(index, shown)
    for run in runs:
        yield _row(case, seed, source, run)


def _frames(source: SyntheticSource, every: int) -> Iterator[tuple[int, RgbdFrame]]:
    if every == 1:
        yield from enumerate(source)
    for index in range(0, len(source), every) if every > 1 else ():
        yield index, source.render(index)


def _row(case: Case, seed: int, source: SyntheticSource, run: Run) -> str:
    truth = source.groundtruth
    assert truth is not None
    accuracy = assess_run(run.record, truth)
    results = [frame.result for frame in run.record.tracked]
    T_first = se3.inverse(source.pose(results[0].stamp_ns))
    off = [
        se3.log(se3.inverse(T_first @ source.pose(r.stamp_ns)) @ r.T_world_cam) for r in results
    ]
    way_m = np.linalg.norm(np.diff(truth.T_world_cam[:, :3, 3], axis=0), axis=1).sum()
    end_cm, end_deg = 100 * np.linalg.norm(off[-1][:3]), np.degrees(np.linalg.norm(off[-1][3:]))
    states = Counter(r.state.value for r in results)
    told = ' '.join(f'{state} {n}' for state, n in sorted(states.items()))
    ate = float('nan') if accuracy.ate is None else accuracy.ate.rmse_cm
    silent = '-' if accuracy.silent is None else str(accuracy.silent.count)
    text = (
        f'{case.name:21s} {seed:4d} {run.variant.name:20s} {ate:7.2f} {end_cm:7.1f} '
        f'{end_cm / way_m:6.2f} {end_deg:7.2f} {silent:>6s}   {told}'
    )
    if 'priors.planar_m' in run.variant.settings and source.T_base_cam is not None:
        base = np.abs(np.array(off) @ se3.adjoint(source.T_base_cam).T)
        tilt_deg = np.degrees(np.hypot(base[:, 3], base[:, 4]).max())
        text += f'; height {100 * base[:, 2].max():.1f} cm, tilt {tilt_deg:.2f} deg off at most'
    if case.covered[1]:
        last = off[case.covered[1] - 1]
        text += (
            f'; as the lens is uncovered {100 * np.linalg.norm(last[:3]):.1f} cm, '
            f'{np.degrees(np.linalg.norm(last[3:])):.2f} deg off'
        )
    if case.name.startswith('tilt'):
        tilts = np.array([_tilt_deg(T_first, r.T_world_cam, source, r.stamp_ns) for r in results])
        text += f'; tilt {tilts.mean():.2f} deg on average, {tilts.max():.2f} at most'
    if run.bias_rad_s:
        at = run.bias_rad_s[min(300, len(run.bias_rad_s)) - 1]
        text += f'; bias after 10 s {np.round(1e3 * at, 1)} mrad/s'
    return text


def _tilt_deg(
    T_first: NDArray[np.float64], T: NDArray[np.float64], source: SyntheticSource, stamp_ns: int
) -> float:
    """Return by how much up is elsewhere in the image of a pose (4, 4) than in truth."""
    seen, true = T[:3, :3].T @ T_first[:3, 2], source.pose(stamp_ns)[:3, :3].T[:, 2]
    return float(np.degrees(np.arccos(min(float(seen @ true), 1.0))))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--only', default='', metavar='TEXT', help='cases with it in their name')
    parser.add_argument('--seeds', type=int, nargs='+', default=[2, 3, 4])
    arguments = parser.parse_args()
    print('case                  seed sensors               ATE cm  end cm  % way end deg silent')
    for case in CASES:
        for seed in arguments.seeds if arguments.only in case.name else ():
            for row in rows(case, seed):
                print(row, flush=True)


if __name__ == '__main__':
    main()
