# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The affine fit of a rendering to its image, and what it must not be led astray by."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.mapping.exposure import Exposure, blended, fitted, mean
from dcgs_ros.core.render.renderer import Rendering

PRIOR = 0.01  # variance that stands for a gain of 1
FIT = 1e-4
SHAPE = (60, 80)
NONE = Exposure.none()
# Within what is taken for exposure: no pixel clips, none differs by more than 0.15.
GAIN, OFFSET = np.array([1.15, 0.9, 1.0]), np.array([-0.03, 0.04, 0.1])


def colors(seed: int, low: float = 0.15, high: float = 0.8) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(low, high, (3, *SHAPE))


def rendering(
    color: NDArray[np.float64], transmittance: NDArray[np.floating] | float = 0.0
) -> Rendering:
    planes = np.zeros((5, *color.shape[1:]), np.float32)
    planes[:3], planes[4] = color, transmittance
    return Rendering(planes)


def target(
    color: NDArray[np.float64], valid: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    return color.astype(np.float32), np.ones(color.shape[1:], np.bool_) if valid is None else valid


def exposed(color: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(GAIN[:, None, None] * color + OFFSET[:, None, None])


def assert_is(
    found: Exposure,
    gain: NDArray[np.floating],
    offset: NDArray[np.floating],
    limit: float = FIT,
) -> None:
    np.testing.assert_allclose(found.gain, gain, atol=limit)
    np.testing.assert_allclose(found.offset, offset, atol=limit)


def expected_fit(
    x: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ridge regression on GAIN and OFFSET: the gain is drawn to 1, the mean is met."""
    sampled = x[:, ::3, ::3].reshape(3, -1)
    variance = sampled.var(axis=1)
    gain = (GAIN * variance + PRIOR) / (variance + PRIOR)
    return gain, GAIN * sampled.mean(axis=1) + OFFSET - gain * sampled.mean(axis=1)


def test_an_affine_map_is_found_up_to_the_prior() -> None:
    x = colors(0)
    found = fitted(rendering(x), *target(exposed(x)), NONE, 1.0)
    assert_is(found, *expected_fit(x))
    assert_is(found, GAIN, OFFSET, limit=0.04)  # the prior matters little where there is contrast
    assert found.gain.dtype == found.offset.dtype == np.float32


def test_channels_are_fitted_by_themselves() -> None:
    x = colors(1)
    y = exposed(x)
    y[1] = x[1]
    found = fitted(rendering(x), *target(y), NONE, 1.0)
    gain, offset = expected_fit(x)
    gain[1], offset[1] = 1.0, 0.0
    assert_is(found, gain, offset)


@pytest.mark.parametrize('share', [0.0, 0.3, 1.0])
def test_a_share_of_the_fit_is_taken_whatever_was_before(share: float) -> None:
    x = colors(2)
    before = Exposure(np.full(3, 2.0, np.float32), np.full(3, 0.5, np.float32))
    found = fitted(rendering(x), *target(exposed(x)), before, share)
    gain, offset = expected_fit(x)
    assert_is(found, 1 + share * (gain - 1), share * offset)


def test_a_flat_image_tells_the_offset_and_no_gain() -> None:
    x = np.full((3, *SHAPE), 0.5)
    found = fitted(rendering(x), *target(x + 0.1), NONE, 1.0)
    assert_is(found, np.ones(3), np.full(3, 0.1))


@pytest.mark.parametrize('extreme', [0.0, 0.02, 0.98, 1.0])
def test_clipped_pixels_tell_nothing(extreme: float) -> None:
    x = colors(3)
    y = exposed(x)
    clipped = np.random.default_rng(4).random(SHAPE) < 0.5
    y[:, clipped], x[:, clipped] = extreme, abs(extreme - 0.1)
    clean = fitted(rendering(x, 1.0 * clipped), *target(y), NONE, 1.0)
    assert_is(fitted(rendering(x), *target(y), NONE, 1.0), clean.gain, clean.offset)


@pytest.mark.parametrize('kind', ['outlier', 'invalid', 'uncovered', 'not finite'])
def test_pixels_that_show_something_else_tell_nothing(kind: str) -> None:
    x = colors(5)
    y, other = exposed(x), np.random.default_rng(6).random(SHAPE) < 0.4
    through, valid = np.zeros(SHAPE), np.ones(SHAPE, np.bool_)
    clean = fitted(rendering(x, 1.0 * other), *target(y), NONE, 1.0)
    shift = 0.3 if kind == 'outlier' else 0.1
    y[:, other] = np.where(x[:, other] < 0.5, x[:, other] + shift, x[:, other] - shift)
    if kind == 'invalid':
        valid[other] = False
    elif kind == 'uncovered':
        through[other] = 0.2
    elif kind == 'not finite':
        y[:, other] = np.nan
    found = fitted(rendering(x, through), *target(y, valid), NONE, 1.0)
    assert_is(found, clean.gain, clean.offset)


def test_too_few_pixels_keep_what_was_before_channel_by_channel() -> None:
    x = colors(7)
    before = Exposure(
        np.array([1.3, 0.8, 0.9], np.float32), np.array([0.1, 0.2, -0.1], np.float32)
    )
    nothing = np.zeros(SHAPE, np.bool_)
    assert_is(fitted(rendering(x), *target(x, nothing), before, 0.6), before.gain, before.offset)
    assert_is(fitted(rendering(x, 1.0), *target(x), before, 0.6), before.gain, before.offset)
    y = exposed(x)
    y[2] = 1.0  # clipped
    found = fitted(rendering(x), *target(y), before, 1.0)
    gain, offset = expected_fit(x)
    gain[2], offset[2] = before.gain[2], before.offset[2]
    assert_is(found, gain, offset)


@pytest.mark.parametrize('size', [(1, 1), (16, 16), (43, 41)])
def test_small_images_keep_what_was_before_too(size: tuple[int, int]) -> None:
    x = np.full((3, *size), 0.5)
    before = Exposure(np.full(3, 1.2, np.float32), np.zeros(3, np.float32))
    found = fitted(rendering(x), *target(x + 0.05), before, 1.0)
    enough = len(range(0, size[0], 3)) * len(range(0, size[1], 3)) >= 200
    assert_is(found, np.full(3, 1.0 if enough else 1.2), np.full(3, 0.05 if enough else 0.0))


@pytest.mark.parametrize('gain', [0.6, 1.5])
def test_a_strong_exposure_is_found_from_one_that_is_near(gain: float) -> None:
    """A view's exposure is fitted again and again: it comes closer each time."""
    x = colors(8, 0.1, 0.6)
    y, found = gain * x, NONE
    for _ in range(20):
        found = blended(found, fitted(rendering(x), *target(y), found, 1.0), 0.5)
    shown = found.gain[:, None, None] * x + found.offset[:, None, None]
    assert np.abs(shown - y).max() < 0.05


def test_blending_goes_a_share_of_the_way() -> None:
    old = Exposure(np.array([1, 2, 3], np.float32), np.zeros(3, np.float32))
    new = Exposure(np.array([2, 2, 1], np.float32), np.array([1, -1, 0], np.float32))
    for share, gain, offset in (
        (0.0, old.gain, old.offset),
        (1.0, new.gain, new.offset),
        (0.25, np.array([1.25, 2, 2.5]), np.array([0.25, -0.25, 0])),
    ):
        found = blended(old, new, share)
        assert_is(found, gain, offset, limit=1e-6)
        assert found.gain.dtype == found.offset.dtype == np.float32


def test_what_is_relative_to_another_exposure_gives_it_back_when_applied_after() -> None:
    view = Exposure(np.array([1.2, 0.9, 1], np.float32), np.array([0.1, -0.1, 0], np.float32))
    common = Exposure(np.array([1.1, 0.8, 2], np.float32), np.array([0, 0.2, -0.1], np.float32))
    x, left = colors(9)[:, 0].astype(np.float32), view.relative_to(common)
    between = common.gain[:, None] * x + common.offset[:, None]
    shown = left.gain[:, None] * between + left.offset[:, None]
    expected = view.gain[:, None] * x + view.offset[:, None]
    np.testing.assert_allclose(shown, expected, atol=1e-6)
    assert_is(view.relative_to(Exposure.none()), view.gain, view.offset, limit=0)
    assert_is(
        mean([view, common]), (view.gain + common.gain) / 2, np.array([0.05, 0.05, -0.05]), 1e-6
    )
