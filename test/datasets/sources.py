# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A sequence in memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.source import BadFrame, ImuSample

START_NS = 1_341_841_280_012_345_678
INTERVAL_NS = 33_333_333
LAG_NS = 15_000_001  # less than half the interval: else the pairs are others
CAMERA = PinholeCamera(64, 48, 50.1, 51.2, 31.3, 23.4, (0.1, -0.2, 0.001, 0.002, 0.05))
SENSOR = SensorNoise(0.0011, 0.0023, 0.15, 7.25)


@dataclass(frozen=True)
class MemorySource:
    """A `Source` of given frames, poses and samples."""

    frames: list[RgbdFrame]
    camera: PinholeCamera = CAMERA
    samples: tuple[ImuSample, ...] = ()
    groundtruth: Trajectory | None = None
    sensor: SensorNoise = SENSOR
    name: str = 'memory'
    depth_per_metre: float | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        return iter(self.frames)

    def imu(self) -> Iterator[ImuSample]:
        return iter(self.samples)


def frames_of(count: int, per_metre: float, grey: bool = False) -> list[RgbdFrame]:
    """Return noise; depth in steps of 1 / `per_metre`, stamped alternately before and after."""
    rng = np.random.default_rng(7)
    frames = []
    for k in range(count):
        color = rng.integers(0, 256, (48, 64) if grey else (48, 64, 3), np.uint8)
        raw = rng.integers(0, 20000, (48, 64)).astype(np.float32)
        raw[k] = 0
        stamp_ns = START_NS + k * INTERVAL_NS
        depth_ns = stamp_ns + (-1) ** k * LAG_NS
        frames.append(RgbdFrame(stamp_ns, depth_ns, color, raw / np.float32(per_metre)))
    return frames


def truth_of(start_ns: int, seconds: float) -> Trajectory:
    """Return poses at 100 Hz of a camera that turns and moves."""
    times = np.arange(0, seconds, 0.01)
    poses = np.array([se3.exp(np.array([t, 0.1, -t, 0.3, t, 0.2])) for t in times])
    return Trajectory(start_ns + np.rint(times * 1e9).astype(np.int64), poses)


def samples_of(count: int, interval_ns: int, apart: bool) -> tuple[ImuSample, ...]:
    """Return samples of both quantities, or of one and the other in turn."""
    samples = []
    for k in range(count):
        acceleration = None if apart and k % 2 else (0.1 * k, 9.8, -0.2)
        rate = None if apart and not k % 2 else (0.01 * k, -0.5, 0.25)
        stamp_ns = START_NS + k * interval_ns + 11
        samples.append(ImuSample(stamp_ns, 'camera_imu_optical_frame', acceleration, rate))
    return tuple(samples)


def same_frames(first: list[RgbdFrame], second: list[RgbdFrame]) -> bool:
    """Return whether stamps and pixels are the same, bit for bit."""
    return len(first) == len(second) and all(
        (a.stamp_ns, a.depth_stamp_ns) == (b.stamp_ns, b.depth_stamp_ns)
        and np.array_equal(a.color, b.color)
        and np.array_equal(a.depth_m, b.depth_m)
        for a, b in zip(first, second, strict=True)
    )
