# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Rendering scores of a map, for one view and averaged over a run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .lpips import Lpips
from .similarity import SimilarityError, psnr_db, ssim

PROTOCOL = 'full'  # every valid pixel, no correction of exposure


@dataclass(frozen=True)
class Scores:
    """Similarity of a rendered and a real image."""

    psnr_db: float
    ssim: float
    lpips: float | None  # None: not computed


@dataclass(frozen=True)
class ViewScores(Scores):
    """The scores of one view under `PROTOCOL`, and under the two others."""

    index: int  # of the frame in the source, from 0
    keyframe: bool
    interpolated: Scores | None  # with the keyframes' exposures interpolated to the frame
    depth_masked: Scores  # with pixels without depth set to black in both images
    mean_transmittance: float  # over the valid pixels; 0 if the map fills the view


def score_view(
    index: int,
    keyframe: bool,
    shown: NDArray[np.float32],
    with_exposure: NDArray[np.float32] | None,
    truth: NDArray[np.float32],
    depth_m: NDArray[np.float32],
    valid: NDArray[np.bool_],
    transmittance: NDArray[np.float32],
    lpips: Lpips | None,
) -> ViewScores:
    """Return the scores of a rendered view `shown` against `truth`, both (H, W, 3), 0 to 1.

    `with_exposure` is the same view with its exposure interpolated. Rendered values are clipped
    to 0 to 1. The scores are over the pixels where `valid` (H, W) is true; LPIPS has no mask and
    gets the truth at the others. `depth_m` (H, W) is 0 where nothing was measured. Raises
    `SimilarityError` if shapes differ or no pixel is valid, `LpipsError` as `Lpips` does.
    """
    for name, plane in (('depth', depth_m), ('valid', valid), ('transmittance', transmittance)):
        if plane.shape != truth.shape[:2]:
            raise SimilarityError(f'{name} is {plane.shape} for an image of {truth.shape}')
    raw = _scores(shown, truth, valid, lpips)
    measured = (depth_m > 0)[..., None]
    return ViewScores(
        raw.psnr_db,
        raw.ssim,
        raw.lpips,
        index,
        keyframe,
        None if with_exposure is None else _scores(with_exposure, truth, valid, lpips),
        _scores(shown * measured, truth * measured, valid, lpips),
        float(transmittance[valid].mean(dtype=np.float64)),
    )


def rendering_report(scores: Sequence[ViewScores]) -> dict[str, Any]:
    """Return the part `rendering` of a report: means over views, of PSNR in dB as is usual.

    A mean is None if no view has a value.
    """
    interpolated = [view.interpolated for view in scores if view.interpolated is not None]
    return {
        **_means(scores),
        'views': len(scores),
        'protocol': PROTOCOL,
        'interpolated': _means(interpolated) if interpolated else None,
        'depth_masked': _means([view.depth_masked for view in scores]),
        'mean_transmittance': _mean(view.mean_transmittance for view in scores),
        'keyframes': _group([view for view in scores if view.keyframe]),
        'others': _group([view for view in scores if not view.keyframe]),
    }


def _scores(
    rendered: NDArray[np.float32],
    truth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    lpips: Lpips | None,
) -> Scores:
    image = np.where(valid[..., None], np.clip(rendered, 0, 1), truth)
    return Scores(
        psnr_db(image, truth, valid),
        ssim(image, truth, valid),
        None if lpips is None else lpips(image, truth),
    )


def _group(scores: Sequence[Scores]) -> dict[str, float | None]:
    return {'views': len(scores), **_means(scores)}


def _means(scores: Sequence[Scores]) -> dict[str, float | None]:
    return {
        'psnr_db': _mean(score.psnr_db for score in scores),
        'ssim': _mean(score.ssim for score in scores),
        'lpips': _mean(score.lpips for score in scores if score.lpips is not None),
    }


def _mean(values: Iterable[float]) -> float | None:
    known = list(values)
    return float(np.mean(known)) if known else None
