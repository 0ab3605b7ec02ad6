# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Noise planes are standard normal, independent, and the same with any number of threads."""

import numba
import numpy as np
import pytest
from scipy.stats import kstest

from dcgs_ros.datasets.synthetic.noise import smoothed, white_noise

SHAPE = (4, 240, 320)
TOLERANCE = 0.015  # five standard errors of a correlation over 240 x 320 samples and some


def correlation(a, b):
    """Pearson's coefficient of two planes."""
    return np.corrcoef(a.ravel(), b.ravel())[0, 1]


def test_white_noise_is_standard_normal():
    """Moments and distribution; the table's steps stay below what the test resolves."""
    planes = white_noise(1, 2, 3, SHAPE)
    assert abs(planes.mean()) < 0.01 and abs(planes.std() - 1) < 0.01
    assert kstest(planes[0, ::5, ::5].ravel(), 'norm').pvalue > 1e-3


def test_planes_pixels_frames_seeds_and_streams_are_independent():
    """No correlation along any of them."""
    planes = white_noise(0, 0, 0, SHAPE)
    for a in range(SHAPE[0]):
        for b in range(a):
            assert abs(correlation(planes[a], planes[b])) < TOLERANCE
    assert abs(correlation(planes[0, :, 1:], planes[0, :, :-1])) < TOLERANCE
    assert abs(correlation(planes[0, 1:], planes[0, :-1])) < TOLERANCE
    for other in ((1, 0, 0), (0, 1, 0), (0, 0, 1)):
        assert abs(correlation(planes[0], white_noise(*other, SHAPE)[0])) < TOLERANCE


@pytest.mark.parametrize('sigma', [1.2, 2.4, 4.0])
def test_smoothing_keeps_the_variance_and_sets_the_correlation(sigma):
    """White noise blurred by sigma is correlated as exp(-d^2 / (4 sigma^2))."""
    plane = smoothed(white_noise(0, 0, 0, SHAPE)[0], sigma)
    assert plane.std() == pytest.approx(1, abs=0.04)
    shift = round(2 * sigma)
    measured = correlation(plane[:, shift:], plane[:, :-shift])
    assert measured == pytest.approx(np.exp(-((shift / sigma) ** 2) / 4), abs=0.06)


def test_threads_change_nothing():
    """The result does not depend on the order of computation."""
    before = numba.get_num_threads()
    two = white_noise(5, 6, 7, SHAPE)
    numba.set_num_threads(1)
    try:
        one = white_noise(5, 6, 7, SHAPE)
    finally:
        numba.set_num_threads(before)
    assert np.array_equal(one, two)
