# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The pixels and the views that each score of a run is computed over."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.evaluation.lpips import Lpips
from dcgs_ros.evaluation.rendering import Scores, ViewScores, rendering_report, score_view
from dcgs_ros.evaluation.similarity import PSNR_MAX_DB, SimilarityError, psnr_db, ssim

SHAPE = (40, 48)
ROUNDING = 1e-6
EVERYWHERE = np.ones(SHAPE, bool)
MEASURED = np.full(SHAPE, 2.0, np.float32)
OPAQUE = np.zeros(SHAPE, np.float32)


def picture(seed: int = 0) -> NDArray[np.float32]:
    """Return a random image of 0.2 to 0.8."""
    return np.random.default_rng(seed).uniform(0.2, 0.8, (*SHAPE, 3)).astype(np.float32)


def score(
    shown: NDArray[np.float32],
    truth: NDArray[np.float32],
    with_exposure: NDArray[np.float32] | None = None,
    depth_m: NDArray[np.float32] = MEASURED,
    valid: NDArray[np.bool_] = EVERYWHERE,
    transmittance: NDArray[np.float32] = OPAQUE,
    lpips: Lpips | None = None,
) -> ViewScores:
    return score_view(7, True, shown, with_exposure, truth, depth_m, valid, transmittance, lpips)


class Recorder(Lpips):
    """Returns the mean difference, and keeps the images."""

    def __init__(self) -> None:
        self.pairs: list[tuple[NDArray[np.floating], NDArray[np.floating]]] = []

    def __call__(self, image: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
        self.pairs.append((image, truth))
        return float(np.abs(image - truth).mean())


def half() -> NDArray[np.bool_]:
    """Mask the left half."""
    mask = np.zeros(SHAPE, bool)
    mask[:, : SHAPE[1] // 2] = True
    return mask


def test_the_full_protocol_is_over_all_pixels_as_they_are_shown() -> None:
    shown, truth = picture(0), picture(1)
    view = score(shown, truth)
    assert (view.index, view.keyframe) == (7, True)
    assert view.psnr_db == pytest.approx(psnr_db(shown, truth))
    assert view.ssim == pytest.approx(ssim(shown, truth))
    assert view.lpips is None
    assert view.interpolated is None
    assert view.depth_masked == Scores(view.psnr_db, view.ssim, None)


def test_exposure_helps_the_interpolated_scores_only() -> None:
    truth = picture()
    shown = 0.8 * truth
    plain, helped = score(shown, truth), score(shown, truth, with_exposure=shown / 0.8)
    assert helped.interpolated is not None
    assert helped.interpolated.psnr_db > PSNR_MAX_DB - 1
    assert replace(helped, interpolated=None) == plain


def test_values_above_one_are_clipped() -> None:
    truth = np.ones((*SHAPE, 3), np.float32)
    view = score(truth + 3, truth, with_exposure=truth + 5)
    assert view.psnr_db == PSNR_MAX_DB
    assert view.interpolated == view.depth_masked == Scores(PSNR_MAX_DB, 1.0, None)


def test_invalid_pixels_count_in_no_score() -> None:
    truth, lpips = picture(), Recorder()
    shown = np.where(half()[..., None], truth, np.float32(np.nan))
    clear = np.where(half(), np.float32(0.25), 1)
    view = score(shown, truth, shown, valid=half(), transmittance=clear, lpips=lpips)
    perfect = Scores(PSNR_MAX_DB, 1.0, 0.0)
    assert (view.psnr_db, view.ssim, view.lpips) == (PSNR_MAX_DB, 1.0, 0.0)
    assert view.interpolated == view.depth_masked == perfect
    assert view.mean_transmittance == pytest.approx(0.25)


def test_depth_holes_are_black_in_both_images_and_count_as_equal() -> None:
    truth, lpips = picture(), Recorder()
    shown = np.where(half()[..., None], truth + np.float32(0.1), np.float32(1.0))
    depth = np.where(half(), np.float32(1.5), 0)
    view = score(shown, truth, depth_m=depth, lpips=lpips)
    assert view.depth_masked.psnr_db == pytest.approx(20 + 10 * np.log10(2), abs=1e-3)
    assert view.psnr_db < 20
    masked_image, masked_truth = lpips.pairs[-1]
    assert not masked_image[~half()].any() and not masked_truth[~half()].any()
    np.testing.assert_allclose(masked_image[half()], shown[half()])


def test_each_protocol_has_its_own_lpips() -> None:
    truth, lpips = picture(), Recorder()
    depth = np.where(half(), np.float32(1.5), 0)
    view = score(truth + np.float32(0.1), truth, truth, depth_m=depth, lpips=lpips)
    assert view.interpolated is not None
    assert view.lpips == pytest.approx(0.1, abs=ROUNDING)
    assert view.interpolated.lpips == 0.0
    assert view.depth_masked.lpips == pytest.approx(0.05, abs=ROUNDING)


def test_planes_of_another_size_are_named() -> None:
    image, narrow = picture(), np.ones((SHAPE[0], 1), np.float32)
    with pytest.raises(SimilarityError, match=r'depth is \(40, 1\) for an image of \(40, 48, 3\)'):
        score(image, image, depth_m=narrow)
    with pytest.raises(SimilarityError, match='valid is'):
        score(image, image, valid=narrow > 0)
    with pytest.raises(SimilarityError, match='transmittance is'):
        score(image, image, transmittance=narrow)
    with pytest.raises(SimilarityError, match=r'none of 1920 pixels is valid'):
        score(image, image, valid=~EVERYWHERE)


def view_scores(index: int, keyframe: bool, lpips: float | None = None) -> ViewScores:
    raw, helped, masked = (Scores(k + index, 0.1 * (k + index), lpips) for k in (20, 30, 25))
    transmittance = 0.01 * index
    return ViewScores(
        raw.psnr_db, raw.ssim, lpips, index, keyframe, helped, masked, transmittance
    )  # fmt: skip


def test_a_report_has_the_means_of_all_views_and_of_either_kind() -> None:
    views = [view_scores(k, keyframe=k == 4) for k in (0, 1, 4)]
    report = rendering_report(views)
    assert report == {
        'psnr_db': pytest.approx(20 + 5 / 3),
        'ssim': pytest.approx(2 + 0.5 / 3),
        'lpips': None,
        'views': 3,
        'protocol': 'full',
        'interpolated': {
            'psnr_db': pytest.approx(30 + 5 / 3),
            'ssim': pytest.approx(3 + 0.5 / 3),
            'lpips': None,
        },
        'depth_masked': {
            'psnr_db': pytest.approx(25 + 5 / 3),
            'ssim': pytest.approx(2.5 + 0.5 / 3),
            'lpips': None,
        },
        'mean_transmittance': pytest.approx(0.05 / 3),
        'keyframes': {'views': 1, 'psnr_db': 24.0, 'ssim': pytest.approx(2.4), 'lpips': None},
        'others': {'views': 2, 'psnr_db': 20.5, 'ssim': pytest.approx(2.05), 'lpips': None},
    }


def test_lpips_is_averaged_over_the_views_that_have_one() -> None:
    views = [view_scores(0, True, 0.2), view_scores(1, False, 0.4), view_scores(2, False)]
    report = rendering_report(views)
    assert report['lpips'] == pytest.approx(0.3)
    assert report['depth_masked']['lpips'] == pytest.approx(0.3)
    assert report['keyframes']['lpips'] == pytest.approx(0.2)
    assert report['others']['lpips'] == pytest.approx(0.4)


def test_a_kind_without_views_has_no_scores() -> None:
    report = rendering_report([replace(view_scores(0, True), interpolated=None)])
    assert report['others'] == {'views': 0, 'psnr_db': None, 'ssim': None, 'lpips': None}
    assert report['interpolated'] is None
    assert rendering_report([])['psnr_db'] is None


def test_a_report_is_strict_json() -> None:
    truth = picture()
    report = rendering_report([score(truth, truth, truth)])
    assert json.loads(json.dumps(report, allow_nan=False)) == report
