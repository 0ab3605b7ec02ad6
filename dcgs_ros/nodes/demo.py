# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Replay, tracker and mapper as three processes over DDS, and what they achieve.

`python -m dcgs_ros.nodes.demo [SOURCE] [--rate 1] [--no-mapper]`
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.errors import DcgsError
from ..core.trajectory import Trajectory
from ..datasets.open import open_source
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
        )


def play(source: str, rate: float, mapper: bool, logs: Path) -> Outcome:
    """Play a source to the nodes; raise `DcgsError` or `TimeoutError` where they fail."""
    opened = open_source(source)
    with Processes(logs) as processes:
        observer = Observer(processes.domain)
        try:
            sensor = sensor_parameters(opened.sensor)
            names = ['tracker', 'mapper'] if mapper else ['tracker']
            reliable = {'node.reliability': 'reliable', 'node.resume': False}
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
            return _outcome(observer, len(opened), opened.groundtruth)
        finally:
            observer.close()


def _await_reports(observer: Observer) -> None:
    """Wait for the last diagnostics."""
    reports = len(observer.history)
    wait_until(lambda: len(observer.history) >= reports + 4, 10.0, 'diagnostics')


def _outcome(observer: Observer, frames: int, truth: Trajectory | None) -> Outcome:
    latencies = observer.latencies_ms()
    if not len(latencies):
        raise DcgsError('the tracker published no odometry')
    ate = None if truth is None else absolute_trajectory_error(observer.trajectory(), truth)
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
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Play, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('source', nargs='?', default='synthetic:room')
    parser.add_argument('--rate', type=float, default=1.0)
    parser.add_argument('--no-mapper', action='store_true')
    chosen = parser.parse_args(arguments)
    logs = Path(tempfile.mkdtemp(prefix='dcgs-demo-'))
    print(f'{chosen.source} at {chosen.rate:g} times its speed; logs in {logs}', flush=True)
    try:
        print(play(chosen.source, chosen.rate, not chosen.no_mapper, logs))
    except (DcgsError, TimeoutError) as error:
        print(f'dcgs demo: {error}; logs in {logs}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
