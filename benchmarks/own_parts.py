# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Parts of the robot in view: `python -m benchmarks.own_parts [--seeds S]`.

A near box, fixed in the image over a third of it, is put into every frame of the synthetic room.
The ATE with and without `self_mask`, and that of the room as it is.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.image_faults import Images, Window, box
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.tracking.result import TrackingState
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.source import Source
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.evaluation.trajectory import absolute_trajectory_error

MASK = '[[0.3, 0.17], [0.7, 0.17], [0.7, 1], [0.3, 1]]'  # where `box` puts it
ADDRESS = 'synthetic:room?frames=150&seed={seed}'
_ONE_MAP = {'keyframes.new_submap_s': 'auto'}  # sub-maps are a kilometre apart
COLUMNS = ('seed', 'scene', 'ATE, cm', 'worst, cm', 'not ok')


def with_box(frames: Sequence[RgbdFrame], source: Source, seed: int) -> list[RgbdFrame]:
    """Return the frames with a box before the camera."""
    images = [Images(frame.color, frame.depth_m) for frame in frames]
    times_s = np.array([frame.stamp_ns for frame in frames]) * 1e-9
    window = Window(images, [], times_s, source.camera, source.sensor, 0, len(frames))
    change, rng = box(moving=False), np.random.default_rng((seed, 1))
    changed = [change(window, k, rng) for k in range(len(frames))]
    return [
        replace(frame, color=image.color, depth_m=image.depth_m)
        for frame, image in zip(frames, changed, strict=True)
    ]


def tracked(
    frames: Sequence[RgbdFrame], source: Source, mask: str
) -> tuple[NDArray[np.float64], int]:
    """Return the poses (N, 4, 4), and of how many frames the state was not ok."""
    config = override(Config(sensor=source.sensor), {'self_mask': mask, **_ONE_MAP})
    tracker = Tracker(source.camera, config)
    results = [tracker.track(frame) for frame in frames]
    doubted = sum(result.state is not TrackingState.OK for result in results)
    return np.array([result.T_world_cam for result in results]), doubted


def rows(seed: int) -> Iterator[list[str]]:
    """Yield the cells of a seed's rows."""
    source = SyntheticSource.from_address(ADDRESS.format(seed=seed))
    frames = [frame for frame in source if isinstance(frame, RgbdFrame)]
    boxed = with_box(frames, source, seed)
    cases = (('as it is', frames, ''), ('box', boxed, ''), ('box, masked', boxed, MASK))
    for name, shown, mask in cases:
        poses, doubted = tracked(shown, source, mask)
        stamps = np.array([frame.stamp_ns for frame in frames])
        assert source.groundtruth is not None
        error = absolute_trajectory_error(Trajectory(stamps, poses), source.groundtruth)
        yield [str(seed), name, f'{error.rmse_cm:.2f}', f'{error.max_cm:.2f}', str(doubted)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, nargs='+', default=[2, 3])
    arguments = parser.parse_args()
    print(f'| {" | ".join(COLUMNS)} |\n|{"---|" * len(COLUMNS)}', flush=True)
    for seed in arguments.seeds:
        for cells in rows(seed):
            print(f'| {" | ".join(cells)} |', flush=True)


if __name__ == '__main__':
    main()
