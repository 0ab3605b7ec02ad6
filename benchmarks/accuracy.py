# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Accuracy of the tracker: `python -m benchmarks.accuracy [--seeds 5] [--data FOLDER]`.

Synthetic scenes with several seeds, and the real sequences found in FOLDER. Prints a line per
experiment: ATE of each seed and their mean, RPE, keyframes, the estimated colour-depth offset, and
lost frames.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.tracking.result import TrackResult
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import Source
from dcgs_ros.evaluation.trajectory import absolute_trajectory_error, relative_pose_error

SYNTHETIC = {  # address without the seed: ablations
    'synthetic:room?': ('full', 'sigma_t', 'shared', 'shared_klt'),
    'synthetic:room?speed=2&': ('full',),
    'synthetic:room?sensor=d435i&': ('full',),
    'synthetic:room?sensor=ideal&': ('full',),
    'synthetic:zigzag?': ('full', 'sigma_t', 'shared', 'shared_klt'),
    'synthetic:plane?': ('full', 'sigma_t', 'shared', 'shared_klt'),
}
REAL = ('tum_fr3_teddy_200', 'mini_fr1_xyz_vga_120')
ABLATIONS = ('full', 'sigma_t', 'shared', 'shared_klt')


@dataclass(frozen=True)
class Score:
    """Errors and counts of one run."""

    ate_cm: float
    rpe_cm: float
    rpe_deg: float
    keyframes_per_s: float
    offset_ms: float
    lost: int


def score(source: Source, frames: Sequence[RgbdFrame], ablation: str) -> Score:
    """Track `frames`, which are in memory, and compare with the source's ground truth."""
    config = override(Config(sensor=source.sensor), {'ablation': ablation})
    tracker = Tracker(source.camera, config)
    results = [tracker.track(frame) for frame in frames]
    estimate = _trajectory(results)
    if source.groundtruth is None:
        raise SystemExit(f'{source.name} has no ground truth')
    ate = absolute_trajectory_error(estimate, source.groundtruth)
    rpe = relative_pose_error(estimate, source.groundtruth)
    seconds = (estimate.stamps_ns[-1] - estimate.stamps_ns[0]) * 1e-9
    return Score(
        ate.rmse_cm,
        rpe.trans_rmse_cm,
        rpe.rot_rmse_deg,
        tracker.keyframes / seconds,
        results[-1].colour_depth_offset_ms,
        sum(r.state.value == 'lost' for r in results),
    )


def _trajectory(results: Sequence[TrackResult]) -> Trajectory:
    stamps_ns = np.array([r.stamp_ns for r in results], np.int64)
    return Trajectory(stamps_ns, np.stack([r.T_world_cam for r in results]))


def _frames(source: Source) -> list[RgbdFrame]:
    return [frame for frame in source if isinstance(frame, RgbdFrame)]


def _synthetic(seeds: int, frames: int) -> Iterator[tuple[str, list[Score]]]:
    for address, ablations in SYNTHETIC.items():
        scores: dict[str, list[Score]] = {ablation: [] for ablation in ablations}
        for seed in range(seeds):
            source = open_source(f'{address}frames={frames}&seed={seed}')
            images = _frames(source)
            for ablation in ablations:
                scores[ablation].append(score(source, images, ablation))
        for ablation in ablations:
            yield f'{address.rstrip("?&")} {ablation}', scores[ablation]


def _real(data: Path) -> Iterator[tuple[str, list[Score]]]:
    for name in REAL:
        if not (data / name).is_dir():
            print(f'{name}: not in {data}')
            continue
        source = open_source(str(data / name))
        images = _frames(source)
        for ablation in ABLATIONS:
            yield f'{name} {ablation}', [score(source, images, ablation)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=5)
    parser.add_argument('--frames', type=int, default=300)
    parser.add_argument('--data', type=Path, default=os.environ.get('DCGS_TEST_DATA'))
    arguments = parser.parse_args()
    print(f'{"":44s}  ATE cm, each seed; mean | RPE cm / deg | keyframes/s | offset ms | lost')
    runs = _synthetic(arguments.seeds, arguments.frames)
    for experiments in (runs, _real(Path(arguments.data)) if arguments.data else ()):
        for name, scores in experiments:
            ates = ' '.join(f'{s.ate_cm:.2f}' for s in scores)
            print(
                f'{name:44s}  {ates}; {np.mean([s.ate_cm for s in scores]):.2f}'
                f' | {np.mean([s.rpe_cm for s in scores]):.2f}'
                f' / {np.mean([s.rpe_deg for s in scores]):.2f}'
                f' | {np.max([s.keyframes_per_s for s in scores]):.1f}'
                f' | {np.mean([s.offset_ms for s in scores]):.1f}'
                f' | {sum(s.lost for s in scores)}',
                flush=True,
            )


if __name__ == '__main__':
    main()
