# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Nodes over a long time: `python -m benchmarks.soak SOURCE [--minutes 15] [--plot FILE.png]`.

Plays a recording in a loop to tracker and mapper, each in its own process, and prints a row per
minute. When the recording starts over the camera jumps, and the frames until the tracker has
relocalised are not tracked.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dcgs_ros.datasets.open import open_source
from dcgs_ros.evaluation.host import machine, rss_mb
from dcgs_ros.nodes.harness.observer import Observer, wait_until
from dcgs_ros.nodes.harness.processes import Processes, sensor_parameters

from .plots import draw_plots

_START_S = 300.0  # limit, with kernels to compile
_IMAGES_MB = 100.0  # budget of keyframe images, reached in the first minutes (default 300)
_WARM_UP_SHARE = 1 / 3  # of the time; growth is measured after it
_COLUMNS = (
    *('minute', 'tracked', 'median ms', 'p95 ms', 'tracker MB', 'mapper MB'),
    *('Gaussians', 'keyframes'),
)


class Row(NamedTuple):
    """Measurements of one interval."""

    minute: float
    tracked: float  # share of the frames
    median_ms: float
    p95_ms: float
    tracker_mb: float
    mapper_mb: float
    gaussians: float  # the tracker's
    keyframes: float  # the mapper's; it keeps images up to mapping.image_memory_mb


def soak(source: str, minutes: float, interval_s: float = 60.0) -> list[Row]:
    """Play for `minutes`; print and return a row per interval."""
    noise = sensor_parameters(open_source(source).sensor)
    rows = []
    with Processes(Path(tempfile.mkdtemp(prefix='dcgs-soak-'))) as processes:
        observer = Observer(processes.domain)
        limited = {'node.reliability': 'reliable', 'node.keyframe_memory_mb': _IMAGES_MB}
        tracker = processes.start('tracker', noise | limited)
        mapper = processes.start('mapper', noise | {'mapping.image_memory_mb': _IMAGES_MB})
        wait_until(
            lambda: observer.ready('dcgs_tracker') and observer.ready('dcgs_mapper'),
            _START_S, 'nodes',
        )  # fmt: skip
        processes.start('replay', {'source': source, 'loop': True})
        start_s = time.monotonic()
        while (time.monotonic() - start_s) < 60.0 * minutes:
            came, sent = observer.came, observer.sent
            time.sleep(interval_s)
            median_ms, p95_ms = np.percentile(observer.latencies_ms(), [50, 95]).tolist()
            rows.append(
                Row(
                    (time.monotonic() - start_s) / 60.0,
                    (observer.came - came) / max(observer.sent - sent, 1),
                    median_ms, p95_ms, _held_mb(tracker), _held_mb(mapper),
                    observer.value('dcgs_tracker', 'gaussians'),
                    observer.value('dcgs_mapper', 'keyframes'),
                )
            )  # fmt: skip
            print('  '.join(f'{value:10.2f}' for value in rows[-1]), flush=True)
        observer.close()
    return rows


def _held_mb(process: subprocess.Popen[bytes]) -> float:
    held_mb = rss_mb(process.pid)
    assert held_mb is not None, f'process {process.pid} has ended'
    return held_mb


def plot(path: Path, rows: list[Row]) -> None:
    """Plot memory and latency over time."""
    minute, _, median_ms, p95_ms, tracker_mb, mapper_mb, *_ = np.array(rows).T
    plots = (
        ('MB (RSS)', {'tracker': tracker_mb, 'mapper': mapper_mb}),
        ('camera_info to odometry, ms', {'median': median_ms, '95th percentile': p95_ms}),
    )
    draw_plots(path, ('minutes', minute), plots)


def main() -> None:
    """Play, and print how much memory and latency have grown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('source')
    parser.add_argument('--minutes', type=float, default=15.0)
    parser.add_argument('--plot', type=Path, metavar='FILE.png')
    arguments = parser.parse_args()
    print(machine())
    print('  '.join(f'{name:>10}' for name in _COLUMNS))
    rows = soak(arguments.source, arguments.minutes)
    if arguments.plot is not None:
        plot(arguments.plot, rows)
    warm, last = rows[int(_WARM_UP_SHARE * len(rows))], rows[-1]
    minutes = max(last.minute - warm.minute, 1e-9)
    for name in ('tracker_mb', 'mapper_mb', 'median_ms'):
        growth = getattr(last, name) - getattr(warm, name)
        print(f'{name}: {growth:+.1f} from minute {warm.minute:.0f}, {growth / minutes:+.2f} each')


if __name__ == '__main__':
    main()
