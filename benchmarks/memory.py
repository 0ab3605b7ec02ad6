# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Memory of mapping, measured in fresh processes: `python -m benchmarks.mapping --memory`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels.workers import Workers, cores
from dcgs_ros.core.keyframe import Keyframe
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.core.slam import Lockstep
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.prefetch import prefetch
from dcgs_ros.evaluation.host import peak_rss_mb, rss_mb

from .plots import draw_plots

Result = TypeVar('Result')

GAUSSIANS, KEYFRAMES, STEPS = 200_000, 100, 20
MAX_PEAK_MB = 1500.0
LONG_RUN = 'synthetic:room?frames=3000'
SAMPLE_EVERY, SHOW_EVERY = 30, 300  # frames


class Sample(NamedTuple):
    """Memory and sizes after some frames."""

    frame: int
    rss_mb: float
    gaussians: int  # the mapper's
    tracked: int  # the tracker's
    views: int
    images_mb: float


def full_map(gaussians: int, keyframes: int, steps: int) -> float:
    """Return the peak in MB of a mapper with a map that most keyframes see most of."""
    source = open_source(f'synthetic:room?frames={keyframes}')
    caps = {'mapping.max_gaussians': gaussians, 'mapping.spawn_stride_px': 64}
    config = override(Config(sensor=source.sensor), caps)
    assert source.groundtruth is not None
    with closing(Workers(cores())) as workers:
        mapper = Mapper(source.camera, config, workers=workers)
        for frame, T_world_cam in zip(source, source.groundtruth.T_world_cam, strict=True):
            assert isinstance(frame, RgbdFrame)
            first, count = len(mapper.views) * gaussians // keyframes, gaussians // keyframes
            mapper.insert(keyframe_of(frame, T_world_cam, source.camera, first, count))
        for _ in range(steps):
            mapper.step(replay=True)
        print(f'{len(mapper.table)} Gaussians, {len(mapper.views)} keyframes', flush=True)
    peak = peak_rss_mb()
    assert peak is not None
    return peak


def keyframe_of(
    frame: RgbdFrame,
    T_world_cam: NDArray[np.float64],
    camera: PinholeCamera,
    first: int,
    count: int,
) -> Keyframe:
    """Return a keyframe with `count` Gaussians that face the camera at pixels with depth."""
    v, u = np.nonzero(frame.depth_m)
    some = np.sort(np.random.default_rng(first).choice(len(v), count, replace=False))
    v, u = v[some], u[some]
    rays = np.insert(camera.undistortion_map[v, u], 2, 1.0, axis=1)
    R, t = T_world_cam[:3, :3], T_world_cam[:3, 3]
    means = (rays * frame.depth_m[v, u, None]) @ R.T + t
    normals = -(rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ R.T
    return Keyframe(
        frame, T_world_cam, T_cam_cam_at_depth=np.eye(4), ids=np.arange(first, first + count),
        means=means.astype(np.float32), normals=normals.astype(np.float32),
    )  # fmt: skip


def long_run(address: str, every: int) -> list[Sample]:
    """Track and map a sequence in lockstep; return a sample after each `every` frames."""
    source = open_source(address)
    config = Config(sensor=source.sensor)
    samples = []
    with closing(Workers(cores())) as workers, closing(prefetch(source)) as frames:
        tracker = Tracker(source.camera, config)
        mapper = Mapper(source.camera, config, workers=workers)
        mapping = Lockstep(tracker, mapper)
        for count, frame in enumerate(frames, 1):
            assert isinstance(frame, RgbdFrame)
            mapping.after(frame, tracker.track(frame))
            mapping.advance()
            if count % every == 0:
                samples.append(_sample(count, mapper, tracker))
                _progress(samples[-1])
    return samples


def _sample(count: int, mapper: Mapper, tracker: Tracker) -> Sample:
    images_mb = 1e-6 * sum(view.bytes for view in mapper.views)
    tracked, held_mb = len(tracker.gaussians), rss_mb()
    assert held_mb is not None
    return Sample(count, held_mb, len(mapper.table), tracked, len(mapper.views), images_mb)


def _progress(sample: Sample) -> None:
    if sample.frame % SHOW_EVERY == 0:
        print(
            f'{sample.frame:6d}  {sample.rss_mb:8.0f}  {sample.gaussians:10d} '
            f'{sample.tracked:10d}  {sample.views:6d}  {sample.images_mb:9.0f}',
            flush=True,
        )


def _in_fresh_process(work: Callable[..., Result], *arguments: Any) -> Result:
    """Return what `work` returns in a fresh process, which has its own peak of memory."""
    with ProcessPoolExecutor(1, get_context('spawn')) as process:
        return process.submit(work, *arguments).result()


def plot(path: Path, samples: Sequence[Sample]) -> None:
    """Plot memory and Gaussians over the frames."""
    frames, held_mb, gaussians, tracked, _, images_mb = np.array(samples).T
    plots = (
        ('MB', {'whole process (RSS)': held_mb, "keyframes' images": images_mb}),
        (
            'Gaussians / 1000',
            {"mapper's": gaussians / 1000, "of them the tracker's": tracked / 1000},
        ),
    )
    draw_plots(path, ('frames', frames), plots, LONG_RUN)


def show(path: Path | None) -> None:
    """Run both experiments; plot the long run to `path`."""
    peak_mb = _in_fresh_process(full_map, GAUSSIANS, KEYFRAMES, STEPS)
    print(f'peak after {STEPS} steps: {peak_mb:.0f} MB (at most {MAX_PEAK_MB:.0f})', flush=True)
    print(f"\n{LONG_RUN}, lockstep\nframes    RSS MB   Gaussians  tracker's   views  images MB")
    samples = _in_fresh_process(long_run, LONG_RUN, SAMPLE_EVERY)
    if path is not None:
        plot(path, samples)
