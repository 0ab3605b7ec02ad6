# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The map after a loop: `python -m benchmarks.seam [--seeds N]`.

Keyframes of a little more than a lap of the synthetic room, at poses that drift by 6 cm and 1.5
degrees over it, are mapped; then they are corrected, and mapped for another 10 s of frames. At the
seam are views half of which was seen a lap before. Their PSNR, and that of the others, is compared
with a map whose poses were right from the beginning, at the same moment and with as many steps.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import closing

import numpy as np
from numpy.typing import NDArray

from benchmarks.covisibility import View, share_seen
from benchmarks.memory import keyframe_of
from dcgs_ros.core import se3
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels.workers import Workers, cores
from dcgs_ros.core.keyframe import Correction
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import Source
from dcgs_ros.evaluation.similarity import psnr_db

ADDRESS = 'synthetic:room?motion=wheeled&speed=3&frames={frames}&seed={seed}'
_FRAMES, _EVERY, _LAP = 276, 12, 150  # the lap takes 220; views so far apart are of two laps
_DRIFT = np.array([0.06, 0.0, 0.0, 0.0, np.radians(1.5), 0.0])  # over all of it
_GAUSSIANS = 1000  # of a keyframe
_AFTER = 300  # frames
COLUMNS = (
    'seed',
    'views',
    'when',
    'at the seam, dB',
    'as if never wrong',
    'elsewhere',
    'likewise',
)


def views_of(source: Source) -> list[View]:
    """Return every twelfth frame with its true pose."""
    truth = source.groundtruth
    assert truth is not None
    frames = [frame for frame in source if isinstance(frame, RgbdFrame)]
    return list(zip(frames, truth.T_world_cam, strict=True))[::_EVERY]


def at_seam(views: list[View], source: Source) -> NDArray[np.bool_]:
    """Return (V,) of which views half was seen in the other lap."""
    apart = _LAP // _EVERY
    others = [views[: max(k - apart, 0)] + views[k + apart :] for k in range(len(views))]
    shares = [
        share_seen(view, known, source.camera) if known else 0.0
        for view, known in zip(views, others, strict=True)
    ]
    return np.array(shares) > 0.5


def drifted(views: list[View]) -> NDArray[np.float64]:
    """Return the poses (V, 4, 4) with a drift that grows."""
    shares = np.linspace(0.0, 1.0, len(views))
    return np.array([T @ se3.exp(s * _DRIFT) for s, (_, T) in zip(shares, views, strict=True)])


def scores(mapper: Mapper, views: list[View]) -> NDArray[np.float64]:
    """Return the PSNR (V,) of the views that the map is made of."""
    found = []
    for view, (frame, _) in zip(mapper.views, views, strict=True):
        shown = np.moveaxis(mapper.render(view.T_world_cam).color, 0, -1)
        real = frame.color.astype(np.float32) / np.float32(255)
        found.append(psnr_db(np.clip(shown, 0.0, 1.0), real))
    return np.array(found)


def mapped(
    source: Source, views: list[View], poses: NDArray[np.float64]
) -> Iterator[NDArray[np.float64]]:
    """Map at some poses (V, 4, 4); yield PSNR (V,): then, once corrected, and 10 s later."""
    config = Config(sensor=source.sensor)
    steps = config.mapping.steps_per_frame
    with closing(Workers(cores())) as workers:
        mapper = Mapper(source.camera, config, workers=workers)
        for k, ((frame, _), T) in enumerate(zip(views, poses, strict=True)):
            mapper.insert(keyframe_of(frame, T, source.camera, k * _GAUSSIANS, _GAUSSIANS))
            for _ in range(round(steps * _EVERY)):
                mapper.step()
        yield scores(mapper, views)
        stamps = np.array([frame.stamp_ns for frame, _ in views], np.int64)
        truth, sure = np.array([T for _, T in views]), np.zeros((len(views), 6, 6))
        none = np.zeros(len(views), np.int32)
        mapper.correct(Correction(1, stamps, truth, sure, none))
        yield scores(mapper, views)
        for _ in range(round(steps * _AFTER)):
            mapper.step()
        yield scores(mapper, views)


def rows(seed: int) -> Iterator[list[str]]:
    """Yield the cells of the rows of a seed."""
    source = open_source(ADDRESS.format(frames=_FRAMES, seed=seed))
    views = views_of(source)
    seam = at_seam(views, source)
    right = mapped(source, views, np.array([T for _, T in views]))
    wrong = mapped(source, views, drifted(views))
    moments = ('before', 'corrected', '10 s later')
    for when, found, reference in zip(moments, wrong, right, strict=True):
        cells = [f'{x[part].mean():.2f}' for part in (seam, ~seam) for x in (found, reference)]
        yield [str(seed), f'{seam.sum()} of {len(seam)}', when, *cells]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=3)
    arguments = parser.parse_args()
    print(f'| {" | ".join(COLUMNS)} |\n|{"---|" * len(COLUMNS)}', flush=True)
    for seed in range(arguments.seeds):
        for cells in rows(seed):
            print(f'| {" | ".join(cells)} |', flush=True)


if __name__ == '__main__':
    main()
