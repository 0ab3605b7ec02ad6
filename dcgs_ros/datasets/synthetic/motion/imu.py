# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Simulated IMU: what a gyro and an accelerometer beside the camera measure along a path."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .path import Path

RATE_HZ = 200
GRAVITY_M_S2 = 9.80665
# IMU to colour camera, axes parallel (x right, y down, z forward): 5.5 mm left, 5.1 down and 11.7
# in front of the left imager (D400 datasheet), which is 15 mm left of the colour camera.
T_CAM_IMU = np.array(
    [[1, 0, 0, -0.0205], [0, 1, 0, 0.0051], [0, 0, 1, 0.0117], [0, 0, 0, 1]], np.float64
)
_STREAM = 7
_BLOCK = 2000  # samples that are computed at once
_STEP_S = 5e-4  # of the differences: far below the path's periods, far above rounding


@dataclass(frozen=True)
class ImuNoise:
    """White noise, a bias that wanders, and where it begins; each axis independently."""

    density: float  # standard deviation per sqrt(Hz)
    walk: float  # of the bias, per s and sqrt(Hz)
    bias: float  # standard deviation of the first bias


# Densities of the BMI055's data sheet: 0.014 degree/s and 150 ug per sqrt(Hz). It states no walk:
# these are of the order that Allan deviations of a D435i at rest give. Biases as they are after
# the camera's own calibration.
GYRO_NOISE = ImuNoise(2.4e-4, 2e-5, 5e-3)  # rad/s
ACCELEROMETER_NOISE = ImuNoise(1.5e-3, 3e-4, 5e-2)  # m/s^2
NO_NOISE = ImuNoise(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ImuBlock:
    """N samples in the IMU's frame."""

    times_s: NDArray[np.float64]  # (N,)
    rates: NDArray[np.float64]  # (N, 3) rad/s
    forces: NDArray[np.float64]  # (N, 3) specific force, m/s^2: at rest it points up


def exact_imu(path: Path, times_s: NDArray[np.float64]) -> ImuBlock:
    """Return what an IMU without errors measures at times (N,), by central differences."""
    h = _STEP_S
    before, now, after = (path.poses(times_s + k * h) @ T_CAM_IMU for k in (-1, 0, 1))
    turned = before[:, :3, :3].transpose(0, 2, 1) @ after[:, :3, :3]
    rates = Rotation.from_matrix(turned).as_rotvec() / (2 * h)
    accelerations = (before + after - 2 * now)[:, :3, 3] / h**2
    accelerations[:, 2] += GRAVITY_M_S2
    return ImuBlock(times_s, rates, np.einsum('nji,nj->ni', now[:, :3, :3], accelerations))


def measured_imu(
    path: Path, start_s: float, end_s: float, seed: int, gyro: ImuNoise, accelerometer: ImuNoise
) -> Iterator[ImuBlock]:
    """Measure at 200 Hz from `start_s` to `end_s`, in blocks; the same with the same seed."""
    rng = np.random.default_rng((seed, _STREAM))
    noises = gyro, accelerometer
    biases = [noise.bias * rng.standard_normal(3) for noise in noises]
    count = int((end_s - start_s) * RATE_HZ) + 1
    for first in range(0, count, _BLOCK):
        indices = np.arange(first, min(first + _BLOCK, count))
        exact = exact_imu(path, start_s + indices / RATE_HZ)
        values = []
        for k, (noise, true) in enumerate(zip(noises, (exact.rates, exact.forces), strict=True)):
            white, steps = rng.standard_normal((2, *true.shape))
            walk = biases[k] + np.cumsum(steps, axis=0) * (noise.walk / np.sqrt(RATE_HZ))
            values.append(true + walk + white * (noise.density * np.sqrt(RATE_HZ)))
            biases[k] = walk[-1]
        yield ImuBlock(exact.times_s, *values)
