# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Localisation in yesterday's map: the second half of a sequence in a map file of the first half.

Beside it the same frames as SLAM tracks them, which goes on from the first half and extends its
map. Each is aligned to the truth for itself, over the frames that both have a pose of.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import Source
from dcgs_ros.evaluation.trajectory import absolute_trajectory_error
from dcgs_ros.io.saved_tracker import SavedTracker
from dcgs_ros.io.tracker_map import read_tracker_map, write_tracker_map

SYNTHETIC = [f'synthetic:room?seed={seed}' for seed in range(3)]
REAL = ['tum_fr3_teddy_200', 'mini_fr1_xyz_vga_120', 'tum_fr1_rpy_240']


@dataclass(frozen=True)
class Scores:
    """What came of the second half."""

    slam_cm: float
    localised_cm: float
    in_map_cm: float  # of localisation, in the alignment of the first half's own trajectory
    frames: int
    lost: int
    first_s: float  # from the first image of the second half to the first pose
    unchanged: bool  # whether the tracker's map is as it was, to the byte


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--data', type=Path, help='folder of the real sequences')
    parser.add_argument('--only', help='a part of the name of a sequence')
    arguments = parser.parse_args()
    addresses = SYNTHETIC + (
        [str(arguments.data / name) for name in REAL] if arguments.data else []
    )
    print(
        '| second half of | SLAM, ATE cm | localised, ATE cm | ratio | in the map, cm | lost | '
        'first pose after s | map unchanged |'
    )
    print('|---|---|---|---|---|---|---|---|')
    for address in addresses:
        if arguments.only is None or arguments.only in address:
            s = halves(open_source(address))
            print(
                f'| {Path(address).name} | {s.slam_cm:.2f} | {s.localised_cm:.2f} | '
                f'{s.localised_cm / s.slam_cm:.2f} | {s.in_map_cm:.2f} | {s.lost} of {s.frames} | '
                f'{s.first_s:.2f} | {"yes" if s.unchanged else "NO"} |',
                flush=True,
            )


def halves(source: Source) -> Scores:
    frames = [item for item in source if isinstance(item, RgbdFrame)]
    half = len(frames) // 2
    slam = Tracker(source.camera, Config(sensor=source.sensor))
    first = [slam.track(frame) for frame in frames[:half]]
    with TemporaryDirectory() as folder:
        write_tracker_map(Path(folder) / 'map.dcgs', slam, source.name)
        known = read_tracker_map(Path(folder) / 'map.dcgs').tracker
    second = [slam.track(frame) for frame in frames[half:]]
    alone = Tracker(source.camera, slam.config)
    known.resume(alone, source.camera)
    alone.localize_only = True
    results = [alone.track(frame) for frame in frames[half:]]
    return _scores(source, first, second, results, known.is_same_map(SavedTracker.of(alone)))


def _scores(
    source: Source,
    first: Sequence[TrackResult],
    slam: Sequence[TrackResult],
    results: Sequence[TrackResult],
    unchanged: bool,
) -> Scores:
    truth = source.groundtruth
    assert truth is not None
    kept = [k for k, (a, b) in enumerate(zip(slam, results, strict=True)) if _has(a) and _has(b)]
    ours = _trajectory([results[k] for k in kept])
    before = [result for result in first if _has(result)]
    # What a robot sees: the alignment is that of the first half, whose map it is in.
    together = absolute_trajectory_error(
        _trajectory([*before, *[results[k] for k in kept]]), truth
    )
    found = next((r.stamp_ns for r in results if _has(r)), results[-1].stamp_ns)
    return Scores(
        absolute_trajectory_error(_trajectory([slam[k] for k in kept]), truth).rmse_cm,
        absolute_trajectory_error(ours, truth).rmse_cm,
        together.rmse_cm,
        len(results),
        sum(not _has(result) for result in results),
        1e-9 * (found - results[0].stamp_ns),
        unchanged,
    )


def _has(result: TrackResult) -> bool:
    return result.state is not TrackingState.LOST


def _trajectory(results: Sequence[TrackResult]) -> Trajectory:
    stamps = np.array([result.stamp_ns for result in results], np.int64)
    return Trajectory(stamps, np.array([result.T_world_cam for result in results]))


if __name__ == '__main__':
    main()
