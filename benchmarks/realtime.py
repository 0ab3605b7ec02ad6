# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Whether the nodes keep up with a camera: `python -m benchmarks.realtime [SOURCE]`.

Three rows, each process a node: 30 Hz with the mapper, 60 Hz without, 30 Hz with the mapper behind
a slow network. Two more for what has to be done in time elsewhere. Each is held against floors,
which are for an idle machine with two cores like that of README.md; the status is 1 where one is
missed. The first line tells how fast this machine is: latencies are also given in times of what
tracking a frame takes here.

SOURCE is a folder, by default tum_fr3_teddy_200 in DCGS_TEST_DATA, else a synthetic room that is
written to one.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.mapping.splats import Splats
from dcgs_ros.datasets.images.depth_registration import register_depth
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.tum.writer import write_tum_folder
from dcgs_ros.evaluation.host import machine
from dcgs_ros.io.ply import read_ply, write_ply
from dcgs_ros.nodes.demo import play

from .tracking import interleaved

ROOT = Path(__file__).resolve().parents[1]
NODES = ROOT / 'test' / 'nodes'  # of the wire
SYNTHETIC = 'synthetic:room?frames=200&sensor=ideal'
REGISTERED_MS = 15.0
LOADED_S = 2.0
MILLION = 1_000_000


@dataclass(frozen=True)
class Floor:
    """What a replay has to come to."""

    tracked: float
    median_ms: float
    p95_ms: float
    ate_cm: float


@dataclass(frozen=True)
class Row:
    """What a replay came to."""

    tracked: float  # share of the pairs
    median_ms: float  # from a frame's camera_info to its odometry
    p95_ms: float
    ate_cm: float | None

    def missed(self, floor: Floor) -> list[str]:
        """Name the floors that it does not reach."""
        kept = {
            'tracked': self.tracked >= floor.tracked,
            'median': self.median_ms <= floor.median_ms,
            'p95': self.p95_ms <= floor.p95_ms,
            'ATE': self.ate_cm is None or self.ate_cm <= floor.ate_cm,
        }
        return [name for name, reached in kept.items() if not reached]


HERE = Floor(0.99, 25.0, 45.0, 0.75)
AWAY = Floor(0.95, 40.0, 100.0, 0.75)  # the wire is a process that takes part of a core


def played(source: str, rate: float, mapper: bool) -> Row:
    """Replay, track and map on this machine."""
    found = play(source, rate, mapper, Path(tempfile.mkdtemp(prefix='dcgs-realtime-')))
    return Row(found.tracked / found.frames, found.median_ms, found.p95_ms, found.ate_cm)


def played_to_another_machine(source: str) -> Row:
    """Replay and track in one network namespace, map in another."""
    logs = tempfile.mkdtemp(prefix='dcgs-realtime-')
    ended = subprocess.run(
        [sys.executable, str(NODES / 'two_machines.py'), logs, '1', source],
        env=os.environ | {'PYTHONPATH': str(ROOT)}, check=True, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    found = json.loads(ended.stdout)
    median_ms, p95_ms = np.percentile(found['latencies_ms'], [50, 95]).tolist()
    return Row(found['tracked'] / found['pairs'], median_ms, p95_ms, found['ate_cm'])


def frame_ms(source: str, count: int = 100) -> float:
    """Mean time of tracking a frame that is in memory, nothing else going on."""
    opened = open_source(source)
    frames = [f for f in islice(opened, count) if isinstance(f, RgbdFrame)]
    interleaved(opened, frames[:10], [1], [0])  # compiles
    return float(interleaved(opened, frames, [1], [0]).mean())


def least_s(work: Callable[[], object], times: int) -> float:
    """Time it a few times."""
    found = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return min(found)


def registering_s() -> float:
    """Register the depth of a D435i to its colour."""
    camera = PinholeCamera(848, 480, 424.0, 424.0, 423.5, 239.5)
    color = PinholeCamera(640, 480, 615.0, 615.0, 319.5, 239.5)
    T = se3.exp(np.array([0.015, 0, 0, 0.005, 0.003, -0.004]))
    depth = np.random.default_rng(0).uniform(0.5, 4.0, (480, 848)).astype(np.float32)
    return least_s(lambda: register_depth(depth, camera, T, color), 6)


def loading_s() -> float:
    """Read a million Gaussians."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'a.ply'
        planes = np.random.default_rng(9).normal(size=(14, MILLION)).astype(np.float32)
        write_ply(path, Splats(planes))
        return least_s(lambda: read_ply(path), 3)


@contextmanager
def recorded(source: str | None) -> Iterator[str]:
    """Name a folder to play from: making synthetic frames takes longer than tracking them."""
    data = os.environ.get('DCGS_TEST_DATA')
    if source is not None or data:
        yield source or str(Path(str(data), 'tum_fr3_teddy_200'))
        return
    with tempfile.TemporaryDirectory() as parent:
        opened = open_source(SYNTHETIC)
        folder = Path(parent) / 'room'
        write_tum_folder(folder, opened, (f for f in opened if isinstance(f, RgbdFrame)))
        yield str(folder)


def print_row(name: str, row: Row, floor: Floor, alone_ms: float) -> bool:
    """Print a row, and its floors; return whether it reaches them."""
    missed = row.missed(floor)
    ate = '     -' if row.ate_cm is None else f'{row.ate_cm:6.2f}'
    print(
        f'{name:24s} {100 * row.tracked:8.1f} {row.median_ms:10.1f} '
        f'{row.median_ms / alone_ms:7.1f} {row.p95_ms:8.1f} {row.p95_ms / alone_ms:7.1f} {ate}'
        f'   {"missed: " + ", ".join(missed) if missed else "reached"} '
        f'({100 * floor.tracked:.0f} %, {floor.median_ms:.0f}, {floor.p95_ms:.0f} ms, '
        f'{floor.ate_cm} cm)',
        flush=True,
    )
    return not missed


def print_time(name: str, ms: float, floor_ms: float) -> bool:
    """Print a time, and its floor; return whether it reaches it."""
    reached = ms <= floor_ms
    print(f'{name:34s} {ms:8.1f} ms   {"reached" if reached else "missed"} ({floor_ms:.0f} ms)')
    return reached


def _without_wire() -> str | None:
    """Say why there is no slow network on this machine, if there is none."""
    sys.path.insert(0, str(NODES))
    import wire  # type: ignore[import-not-found]

    return wire.why_not()


def main() -> int:
    """Print the tables; return 1 where a floor is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('source', nargs='?')
    with recorded(parser.parse_args().source) as source:
        alone_ms = frame_ms(source)
        print(f'{machine()}\n{Path(source).name}: {1e3 / alone_ms:.0f} frames/s, ', end='')
        print(f'{alone_ms:.1f} ms each, in memory, one thread\n')
        print(f'{"":24s} tracked%  median ms   times   p95 ms   times ATE cm   floors')
        reached = [
            print_row('30 Hz, mapper running', played(source, 1.0, True), HERE, alone_ms),
            print_row('60 Hz, tracker alone', played(source, 2.0, False), HERE, alone_ms),
        ]
        lacking = _without_wire()
        if lacking is None:
            found = played_to_another_machine(source)
            reached.append(print_row('30 Hz, mapper far away', found, AWAY, alone_ms))
        else:
            print(f'30 Hz, mapper far away: not measured, {lacking}')
    print()
    reached += [
        print_time('depth of a D435i, registered', 1e3 * registering_s(), REGISTERED_MS),
        print_time('a million Gaussians from a PLY', 1e3 * loading_s(), 1e3 * LOADED_S),
    ]
    return int(not all(reached))


if __name__ == '__main__':
    sys.exit(main())
