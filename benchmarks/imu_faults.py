# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How soon a faulty gyro is left out: `python -m benchmarks.imu_faults [--seeds 2 3 4 5]`.

The gyro of the synthetic motions is compared with their true rotations, as noisy as images make
them, and goes wrong after 10 s. Prints when it is left out, for each motion, and for how long a
right one is within a minute. No image is rendered.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dcgs_ros.core import se3
from dcgs_ros.core.priors.gyro import Gyro
from dcgs_ros.core.priors.readings import AngularRate
from dcgs_ros.datasets.synthetic.source import SyntheticSource

MOTIONS = (
    'room', 'room?speed=2.5', 'room?motion=wheeled', 'room?motion=turning', 'corridor',
    'ring?motion=errand',
)  # fmt: skip
_SECONDS, _FAULTY_S = 60, 10
_IMAGES_RAD = 2e-3  # standard deviation of a rotation by images, on an axis
_WINDOW, _RATE_HZ = 15, 30  # frames over which the tracker compares
_AHEAD_NS = 20_000_000  # of a frame's stamp: readings that are there when it is

Fault = Callable[
    [AngularRate, AngularRate], AngularRate | None
]  # of a reading, the last right one


def _late(milliseconds: int) -> Fault:
    return lambda r, last: AngularRate(r.stamp_ns + milliseconds * 1_000_000, r.rate)


def _turned(degrees: float, axis: str) -> Fault:
    R = Rotation.from_euler(axis, degrees, degrees=True)
    return lambda r, last: AngularRate(r.stamp_ns, R.apply(r.rate))


FAULTS: dict[str, Fault] = {
    'none': lambda r, last: r,
    'dead': lambda r, last: None,
    'frozen': lambda r, last: AngularRate(r.stamp_ns, last.rate),
    'late by 60 ms': _late(60),
    'late by 120 ms': _late(120),
    'mounted 90 degrees off, z': _turned(90, 'z'),
    'mounted 90 degrees off, x': _turned(90, 'x'),
    'mounted 180 degrees off, z': _turned(180, 'z'),
}


def rates(source: SyntheticSource, fault: Fault) -> Iterator[AngularRate]:
    """Yield the readings; the fault begins after 10 s."""
    last: AngularRate | None = None
    begins_ns = source.groundtruth.stamps_ns[0] + _FAULTY_S * 1_000_000_000  # type: ignore[union-attr]
    for sample in source.imu():
        reading: AngularRate | None = AngularRate(
            sample.stamp_ns, np.array(sample.angular_velocity)
        )
        assert reading is not None
        if last is None or reading.stamp_ns < begins_ns:
            last = reading
        else:
            reading = fault(reading, last)
        if reading is not None:
            yield reading


def left_out(source: SyntheticSource, fault: Fault, seed: int) -> NDArray[np.float64]:
    """Return at which seconds (N,) of the faults, each half second, the gyro is left out."""
    gyro, readings, rng = Gyro(source.T_cam_imu[:3, :3]), rates(source, fault), _rng(seed)
    truth, seconds = source.groundtruth, []
    assert truth is not None
    stamps_ns = truth.stamps_ns[::_WINDOW].tolist()
    R = [
        T[:3, :3] @ se3.exp(np.array([0, 0, 0, *(_IMAGES_RAD * rng.standard_normal(3))]))[:3, :3]
        for T in truth.T_world_cam[::_WINDOW]
    ]
    held = next(readings, None)
    for k, (start_ns, end_ns) in enumerate(pairwise(stamps_ns), start=1):
        while held is not None and held.stamp_ns <= end_ns + _AHEAD_NS:
            gyro.sense(held)
            held = next(readings, None)
        gyro.learn(start_ns, end_ns, R[k - 1].T @ R[k], 2 * _IMAGES_RAD**2 * np.eye(3))
        if gyro.reason(end_ns) is not None:
            seconds.append(k * _WINDOW / _RATE_HZ - _FAULTY_S)
    return np.array(seconds)


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng((seed, 40))


def main() -> None:
    """Print a row for each fault, a column for each motion."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, nargs='+', default=[2, 3, 4, 5])
    seeds = parser.parse_args().seeds
    print('| gyro | ' + ' | '.join(f'`{motion}`' for motion in MOTIONS) + ' |')
    for name, fault in FAULTS.items():
        cells = []
        for motion in MOTIONS:
            mark = '&' if '?' in motion else '?'
            sources = [
                SyntheticSource.from_address(
                    f'synthetic:{motion}{mark}sensor=d435i&frames={_SECONDS * _RATE_HZ}&seed={s}'
                )
                for s in seeds
            ]
            out = [left_out(source, fault, s) for source, s in zip(sources, seeds, strict=True)]
            cells.append(_cell(out, name == 'none'))
        print(f'| {name} | ' + ' | '.join(cells) + ' |', flush=True)


def _cell(out: list[NDArray[np.float64]], right: bool) -> str:
    """Return when the gyro was left out first; of a right one, for how many seconds."""
    if right:
        return f'{sum(len(seconds) for seconds in out) * _WINDOW / _RATE_HZ:g} s'
    return ', '.join('never' if len(s) == 0 or s.max() < 0 else f'{s[s >= 0][0]:g}' for s in out)


if __name__ == '__main__':
    main()
