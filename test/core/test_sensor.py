# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Noise laws and the spectrum of S(v, z; s)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dcgs_ros.core.sensor import SensorError, SensorNoise

EXACT = 1e-12  # relative
MILLIMETRE = 1e-3
LAWS = {
    'structured light': SensorNoise.structured_light(),
    'stereo': SensorNoise.stereo(385.0, 0.05),
    'floor': SensorNoise.floor(),
}


@pytest.fixture(params=LAWS.values(), ids=list(LAWS))
def sensor(request: pytest.FixtureRequest) -> SensorNoise:
    """One law after the other."""
    law: SensorNoise = request.param
    return law


def unit_rays(count: int, seed: int) -> NDArray[np.float64]:
    rays = np.random.default_rng(seed).normal(size=(count, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@pytest.mark.parametrize('lateral_px', [0.5, 1.0, 2.0])
def test_covariance_has_the_spectrum_of_the_paper(sensor: SensorNoise, lateral_px: float) -> None:
    """Sigma_z^2 along the ray, (z s / f)^2 twice across it."""
    rays, ranges = unit_rays(50, seed=1), np.random.default_rng(2).uniform(0.3, 6.0, 50)
    for v, z, S in zip(
        rays, ranges, sensor.covariance(rays, ranges, lateral_px, 525.0), strict=True
    ):
        across, along = (z * lateral_px / 525.0) ** 2, float(sensor.sigma(z)) ** 2
        np.testing.assert_allclose(S, S.T)
        np.testing.assert_allclose(S @ v, along * v, rtol=EXACT, atol=EXACT * along)
        np.testing.assert_allclose(
            np.linalg.eigvalsh(S), np.sort([across, across, along]), rtol=1e-9
        )


def test_covariance_turns_with_the_ray(sensor: SensorNoise) -> None:
    """S(R v) = R S(v) R^T."""
    rays, ranges = unit_rays(20, seed=3), np.linspace(0.4, 5.0, 20)
    R = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    np.testing.assert_allclose(
        sensor.covariance(rays @ R.T, ranges, 0.5, 525.0),
        R @ sensor.covariance(rays, ranges, 0.5, 525.0) @ R.T,
        atol=1e-15,
    )


@given(st.floats(1e-4, 1e-2), st.floats(0.0, 1e-2), st.floats(0.1, 10.0), st.floats(0.1, 10.0))
def test_sigma_is_a_floor_and_a_square(a: float, b: float, z: float, w: float) -> None:
    sensor = SensorNoise(a, b)
    assert float(sensor.sigma(0.0)) == a
    assert float(sensor.sigma(z)) == pytest.approx(a + b * z * z, rel=EXACT)
    grown = float(sensor.sigma(w)) - float(sensor.sigma(z))
    assert grown == pytest.approx(b * (w - z) * (w + z), rel=1e-9, abs=1e-15)


def test_structured_light_follows_nguyen() -> None:
    """0.0012 + 0.0019 (z - 0.4)^2 metres over the range it was measured in."""
    sensor, z = SensorNoise.structured_light(), np.linspace(0.4, 3.0, 50)
    nguyen = 0.0012 + 0.0019 * (z - 0.4) ** 2
    assert np.abs(sensor.sigma(z) - nguyen).max() < MILLIMETRE


def test_stereo_follows_the_derivative_of_disparity() -> None:
    """D = f b / z, so an error of s pixels in d is one of s z^2 / (f b) in z, beside the floor."""
    focal, baseline, subpixel = 400.0, 0.055, 0.1
    sensor = SensorNoise.stereo(focal, baseline, subpixel)
    floor = float(sensor.sigma(0.0))
    for z in (0.5, 1.0, 3.0):
        disparity = focal * baseline / z
        step = 1e-4 * subpixel
        slope = (focal * baseline / (disparity - step) - z) / step
        assert float(sensor.sigma(z)) - floor == pytest.approx(subpixel * slope, rel=1e-3)


def test_floor_is_constant() -> None:
    sensor = SensorNoise.floor(0.002)
    np.testing.assert_array_equal(sensor.sigma(np.array([0.1, 1.0, 10.0])), 0.002)


@pytest.mark.parametrize(
    'arguments',
    [
        (0.0, 0.001), (-0.001, 0.001), (0.001, -0.1), (np.nan, 0.001), (0.001, np.nan),
        (0.001, 0.001, -0.1, 5.0), (0.001, 0.001, 2.0, 2.0), (0.001, 0.001, 3.0, 2.0),
        (0.001, 0.001, np.nan, 2.0), (0.001, 0.001, 0.3, np.nan),
        (0.001, 0.001, 0.3, 5.0, -1.0), (0.001, 0.001, 0.3, 5.0, np.nan),
    ],
)  # fmt: skip
def test_impossible_noise_is_refused(arguments: tuple[float, ...]) -> None:
    with pytest.raises(SensorError, match='got'):
        SensorNoise(*arguments)


@pytest.mark.parametrize(
    'arguments', [(0.0, 0.05), (385.0, 0.0), (385.0, -0.1), (385.0, 0.05, -1)]
)
def test_impossible_stereo_is_refused(arguments: tuple[float, ...]) -> None:
    with pytest.raises(SensorError, match='baseline'):
        SensorNoise.stereo(*arguments)
