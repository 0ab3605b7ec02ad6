# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Replay, tracker and mapper as three processes over DDS, and what they achieve.

`python -m dcgs_ros.nodes.demo [SOURCE] [--rate 1] [--no-mapper] [--priors]`
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import se3
from ..core.errors import DcgsError
from ..core.trajectory import Trajectory
from ..datasets.open import open_source
from ..datasets.source import RobotSource, Source
from ..evaluation.trajectory import absolute_trajectory_error
from .harness.observer import Observer, wait_until
from .harness.processes import Processes, sensor_parameters

_LOADED_S = 300.0  # the first time kernels are compiled
_SETTLE_S = 2.0


@dataclass(frozen=True)
class Outcome:
    """The figures of a replay."""

    frames: int
    tracked: int
    median_ms: float  # from a frame's camera_info to its odometry
    p95_ms: float
    ate_cm: float | None
    gaussians: int  # of the mapper
    keyframes: int
    steps_per_s: float
    priors: dict[str, str]  # whether each that is asked for was used at the end

    def __str__(self) -> str:
        """Return the figures in a few lines."""
        ate = '-' if self.ate_cm is None else f'{self.ate_cm:.2f} cm'
        return (
            f'  tracked       {self.tracked} of {self.frames} pairs\n'
            f'  latency       {self.median_ms:.1f} ms median, {self.p95_ms:.1f} p95, camera_info '
            'to odometry\n'
            f'  ATE           {ate}\n'
            f'  map           {self.gaussians} Gaussians, {self.keyframes} keyframes, '
            f'{self.steps_per_s:.1f} steps a second'
            + ''.join(f'\n  {name:13s} {why}' for name, why in self.priors.items())
        )


def play(source: str, rate: float, mapper: bool, logs: Path, with_priors: bool = False) -> Outcome:
    """Play a source to the nodes; raise `DcgsError` or `TimeoutError` where they fail.

    With priors the tracker uses the sensors of which the source tells where they are.
    """
    opened = open_source(source)
    with Processes(logs) as processes:
        observer = Observer(processes.domain)
        try:
            sensor = sensor_parameters(opened.sensor)
            names = ['tracker', 'mapper'] if mapper else ['tracker']
            reliable = {'node.reliability': 'reliable', 'node.resume': False}
            reliable |= sensors_of(opened) if with_priors else {}
            for name in names:
                processes.start(name, sensor | (reliable if name == 'tracker' else {}))
            wait_until(
                lambda: all(observer.ready(f'dcgs_{name}') for name in names), _LOADED_S, 'nodes'
            )
            replay = processes.start(
                'replay', {'source': source, 'rate': float(rate), 'wait_for_subscribers': 1}
            )
            duration_s = _LOADED_S + len(opened) / (30.0 * rate)
            if replay.wait(duration_s):
                raise DcgsError(f'replay ended with {replay.returncode}; see {logs}')
            wait_until(lambda: observer.status != {}, _SETTLE_S, 'diagnostics')
            _await_reports(observer)
            return _outcome(observer, opened, with_priors)
        finally:
            observer.close()


def _await_reports(observer: Observer) -> None:
    """Wait for the last diagnostics."""
    reports = len(observer.history)
    wait_until(lambda: len(observer.history) >= reports + 4, 10.0, 'diagnostics')


def sensors_of(source: Source) -> dict[str, object]:
    """Return the tracker's parameters for the sensors beside the camera, TF or not."""
    if not isinstance(source, RobotSource):
        return {}
    chosen: dict[str, object] = {}
    if source.T_cam_imu is not None:
        chosen |= {'priors.gyro': True, 'node.camera_to_imu': _pose_text(source.T_cam_imu)}
    if source.T_base_cam is not None and next(source.odometry(), None) is not None:
        chosen |= {'priors.wheels': True, 'node.base_to_camera': _pose_text(source.T_base_cam)}
        chosen['node.base_frame'] = source.base_frame
    return chosen


def _pose_text(T: NDArray[np.float64]) -> str:
    w, x, y, z = se3.to_quaternion(T).tolist()
    return ' '.join(f'{number:.9f}' for number in (*T[:3, 3].tolist(), x, y, z, w))


def _cameras(observer: Observer, source: Source, with_priors: bool) -> Trajectory:
    """Return where the camera was; poses of the base tell it by where that is on it."""
    found = observer.trajectory()
    if not with_priors or 'node.base_to_camera' not in sensors_of(source):
        return found
    assert isinstance(source, RobotSource) and source.T_base_cam is not None
    return replace(found, T_world_cam=found.T_world_cam @ source.T_base_cam)


def _outcome(observer: Observer, source: Source, with_priors: bool) -> Outcome:
    latencies = observer.latencies_ms()
    if not len(latencies):
        raise DcgsError('the tracker published no odometry')
    truth, frames = source.groundtruth, len(source)
    ate = None
    if truth is not None:
        ate = absolute_trajectory_error(_cameras(observer, source, with_priors), truth)
    median_ms, p95_ms = np.percentile(latencies, [50, 95]).tolist()
    return Outcome(
        frames=frames,
        tracked=len(observer.poses),
        median_ms=median_ms,
        p95_ms=p95_ms,
        ate_cm=None if ate is None else ate.rmse_cm,
        gaussians=int(observer.value('dcgs_mapper', 'gaussians')),
        keyframes=int(observer.value('dcgs_mapper', 'keyframes')),
        steps_per_s=observer.value('dcgs_mapper', 'steps_per_s'),
        priors={
            key.removeprefix('prior_'): value
            for key, value in observer.status['dcgs_tracker'][2].items()
            if key.startswith('prior_')
        },
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Play, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('source', nargs='?', default='synthetic:room')
    parser.add_argument('--rate', type=float, default=1.0)
    parser.add_argument('--no-mapper', action='store_true')
    parser.add_argument('--priors', action='store_true')
    chosen = parser.parse_args(arguments)
    logs = Path(tempfile.mkdtemp(prefix='dcgs-demo-'))
    print(f'{chosen.source} at {chosen.rate:g} times its speed; logs in {logs}', flush=True)
    try:
        print(play(chosen.source, chosen.rate, not chosen.no_mapper, logs, chosen.priors))
    except (DcgsError, TimeoutError) as error:
        print(f'dcgs demo: {error}; logs in {logs}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
