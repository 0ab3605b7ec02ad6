# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""PSNR and SSIM against closed forms and against another implementation."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.evaluation.similarity import PSNR_MAX_DB, SimilarityError, psnr_db, ssim

HALF_WINDOW_PX = 5
PSNR_DB = 1e-5  # rounding of float32 images
SSIM_FLOAT32 = 2e-6  # on the mean
Score = Callable[..., float]


def picture(seed: int, height: int = 60, width: int = 80) -> NDArray[np.float32]:
    """Return smooth blobs of colour, from 0 to 1."""
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.random((height, width, 3)), (0, 0), 2.0)
    image = (image - image.min()) / np.ptp(image)
    return image.astype(np.float32)


def noisy(image: NDArray[np.float32], sigma: float, seed: int = 1) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    return np.clip(image + sigma * rng.normal(size=image.shape), 0, 1).astype(np.float32)


@pytest.mark.parametrize('shift', [1e-3, 0.1, 1.0])
def test_psnr_of_a_constant_shift_is_its_size_in_db(shift: float) -> None:
    truth = np.zeros((20, 30, 3), np.float32)
    assert psnr_db(truth + np.float32(shift), truth) == pytest.approx(
        -20 * np.log10(shift), abs=PSNR_DB
    )


def test_psnr_averages_over_channels() -> None:
    truth = np.zeros((20, 30, 3), np.float32)
    red = truth + np.array([0.3, 0, 0], np.float32)
    assert psnr_db(red, truth) == pytest.approx(-10 * np.log10(0.03), abs=PSNR_DB)


def test_equal_images_have_the_highest_scores() -> None:
    image = picture(0)
    assert psnr_db(image, image) == PSNR_MAX_DB
    assert ssim(image, image) == 1.0


@pytest.mark.parametrize('score', [psnr_db, ssim])
def test_scores_are_symmetric_and_fall_with_noise(score: Score) -> None:
    truth = picture(0)
    steps = [noisy(truth, sigma) for sigma in (0.01, 0.03, 0.1, 0.3)]
    scores = [score(image, truth) for image in steps]
    assert scores == sorted(scores, reverse=True)
    assert score(truth, steps[1]) == pytest.approx(scores[1], rel=1e-7)


@pytest.mark.parametrize('pair', ['noise', 'other', 'bright and flat'])
def test_ssim_is_that_of_scikit_image_with_zeros_around_the_images(pair: str) -> None:
    truth = picture(0) if pair != 'bright and flat' else 0.95 + 0.002 * picture(0)
    image = picture(1) if pair == 'other' else noisy(truth, 0.05 if pair == 'noise' else 0.001)
    assert ssim(image, truth) == pytest.approx(reference(image, truth).mean(), abs=SSIM_FLOAT32)


def test_ssim_over_a_mask_takes_the_rest_from_the_truth() -> None:
    truth, valid = picture(0), picture(2)[..., 0] > 0.4
    image = noisy(truth, 0.1)
    filled = np.where(valid[..., None], image, truth)
    expected = reference(filled, truth)[valid].mean()
    assert ssim(image, truth, valid) == pytest.approx(expected, abs=SSIM_FLOAT32)


def reference(image: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return SSIM (H, W, 3) by scikit-image in float64, padded to keep its border away."""
    metrics = pytest.importorskip('skimage.metrics')
    around = [(2 * HALF_WINDOW_PX, 2 * HALF_WINDOW_PX)] * 2 + [(0, 0)]
    _, similarity = metrics.structural_similarity(
        np.pad(image.astype(np.float64), around),
        np.pad(truth.astype(np.float64), around),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )
    inside = slice(2 * HALF_WINDOW_PX, -2 * HALF_WINDOW_PX)
    return similarity[inside, inside]


@pytest.mark.parametrize('score', [psnr_db, ssim])
def test_values_at_invalid_pixels_do_not_count(score: Score) -> None:
    truth, valid = picture(0), picture(2)[..., 0] > 0.4
    image = noisy(truth, 0.1)
    poisoned = np.where(valid[..., None], image, np.float32(np.nan))
    assert score(poisoned, truth, valid) == score(image, truth, valid)
    assert score(image, truth, np.ones_like(valid)) == pytest.approx(score(image, truth), rel=1e-9)


@pytest.mark.parametrize('score', [psnr_db, ssim])
def test_float64_gives_the_same(score: Score) -> None:
    truth = picture(0)
    image = noisy(truth, 0.1)
    wide = score(image.astype(np.float64), truth.astype(np.float64))
    assert wide == pytest.approx(score(image, truth), abs=SSIM_FLOAT32)


@pytest.mark.parametrize('score', [psnr_db, ssim])
def test_images_that_cannot_be_compared_are_refused_with_their_shapes(score: Score) -> None:
    truth = picture(0)
    with pytest.raises(SimilarityError, match=r'\(60, 80, 3\) and \(59, 80, 3\)'):
        score(truth, truth[1:])
    with pytest.raises(SimilarityError, match=r'\(3, 60, 80\)'):
        score(np.moveaxis(truth, 2, 0), np.moveaxis(truth, 2, 0))
    with pytest.raises(SimilarityError, match='none of 4800 pixels is valid'):
        score(truth, truth, np.zeros((60, 80), bool))
    with pytest.raises(SimilarityError, match='none of 0 pixels is valid'):
        score(truth[:0], truth[:0])
    with pytest.raises(SimilarityError, match=r'valid is uint8 \(60, 80\), not bool'):
        score(truth, truth, np.ones((60, 80), np.uint8))
