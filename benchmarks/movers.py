# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Things that move before the camera: `python -m benchmarks.movers [--seeds 2 3]`.

The room with a measured D435i, without and with a person who crosses, a door that opens and a box
that is carried by. Ghosts are Gaussians more than 10 cm from all that is there in the end whose
place a depth image has seen empty; `left` are all so far from it, unseen ones included.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.tracking.gaussian_map import EMPTY, verdicts_on
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.synthetic.scenes.movers import MOVERS
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.evaluation.report import RunRecord, TrackedFrame, assess_run

_ROOM = 'synthetic:room?sensor=d435i_measured&speed=0.5&frames=180'
_FAR_M = 0.1  # from every surface: no error of the map
_EVERY = 5  # frames, of those that tell which places are empty
_AT_ONCE = 2000  # Gaussians


def ghosts(source: SyntheticSource, tracker: Tracker, frames: list[RgbdFrame]) -> tuple[int, int]:
    """Return how many Gaussians are ghosts, and how many are left of the mover, seen or not."""
    means = tracker.gaussians.means[tracker.gaussians.ids >= 0]
    left = means[_clearance(source, frames[-1], means) > _FAR_M]
    empty = np.zeros(len(left), np.bool_)
    for frame in frames[::_EVERY]:
        verdicts = verdicts_on(
            left, source.pose(frame.depth_stamp_ns), frame.depth_m, source.camera, source.sensor
        )
        occupied = _clearance(source, frame, left) < _FAR_M
        empty = (empty | (verdicts == EMPTY)) & ~occupied  # what was empty before it came is not
    return int(empty.sum()), len(left)


def _clearance(
    source: SyntheticSource, frame: RgbdFrame, points: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return the distance (N,) of points (N, 3) to what is there at a frame's time."""
    scene = source.scene_at(frame.stamp_ns)
    parts = [points[k : k + _AT_ONCE] for k in range(0, len(points), _AT_ONCE)]
    return np.concatenate([np.empty(0), *(scene.clearance(part.astype(float)) for part in parts)])


def run(mover: str, seed: int) -> None:
    """Track one sequence and print its row."""
    address = f'{_ROOM}&seed={seed}' + (f'&mover={mover}' if mover else '')
    source = SyntheticSource.from_address(address)
    frames = list(source)
    first = se3.orthonormalised(source.pose(frames[0].stamp_ns))
    tracker = Tracker(source.camera, Config(sensor=source.sensor), first)
    record = RunRecord(address, 'full')
    for index, frame in enumerate(frames):
        record.tracked.append(TrackedFrame(index, tracker.track(frame), 0.0, 0))
    accuracy = assess_run(record, source.groundtruth)
    states = [state.value for state in record.claims().states]
    silent = accuracy.silent.count if accuracy.silent else 0
    seen, left = ghosts(source, tracker, frames)
    ate = accuracy.ate.rmse_cm if accuracy.ate else float('nan')
    print(
        f'| {mover or "none"} | {seed} | {ate:.2f} | {states.count("lost")} | {silent} | {seen} '
        f'| {left} |',
        flush=True,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, nargs='+', default=[2, 3])
    arguments = parser.parse_args()
    print(
        '| mover | seed | ATE, cm | lost | silent | ghosts | left |\n|---|---|---|---|---|---|---|'
    )
    for seed in arguments.seeds:
        for mover in ('', *MOVERS):
            run(mover, seed)


if __name__ == '__main__':
    main()
