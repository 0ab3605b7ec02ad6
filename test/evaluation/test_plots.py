# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The plot shows where the camera was lost, and what was claimed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.tracking.result import TrackingState
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.evaluation import plots
from dcgs_ros.evaluation.consistency import Claims
from dcgs_ros.evaluation.plots import plot_trajectory

OK, LOST = TrackingState.OK, TrackingState.LOST
FRAME_NS = 100_000_000
SIGMA_M = 0.01


def a_walk(states: list[TrackingState]) -> Claims:
    count = len(states)
    poses = np.stack(
        [se3.exp(np.array([np.sin(0.3 * k), 0.1 * k, 0, 0, 0, 0])) for k in range(count)]
    )
    covariances = np.tile(np.diag([SIGMA_M**2, 0, 0, 0, 0, 0]), (count, 1, 1))
    stamps = FRAME_NS * np.arange(count, dtype=np.int64)
    path, one_map = Trajectory(stamps, poses), np.zeros(count, np.int32)
    return Claims(path, tuple(states), 4 * covariances, covariances, one_map, path)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Return the figures that are drawn from now on."""
    figures: list[Figure] = []

    def kept(*args: Any, **kwargs: Any) -> Figure:
        figures.append(Figure(*args, **kwargs))
        return figures[-1]

    monkeypatch.setattr(plots, 'Figure', kept)
    return figures


def line(figure: Figure, axes: int, label: str) -> NDArray[np.float64]:
    """Return x and y (2, N) of the line whose label begins with this."""
    lines = figure.axes[axes].lines
    found = next(line for line in lines if str(line.get_label()).startswith(label))
    return np.array(found.get_data(), np.float64)


@pytest.mark.slow
@pytest.mark.parametrize('with_truth', [True, False])
@pytest.mark.parametrize('lost', [set(), set(range(10, 15)), set(range(1, 30))])
def test_it_is_a_png_with_the_claimed_band_and_the_states(
    tmp_path: Path, drawn: list[Figure], with_truth: bool, lost: set[int]
) -> None:
    claims = a_walk([LOST if k in lost else OK for k in range(30)])
    truth = claims.poses if with_truth and len(lost) < 29 else None
    path = tmp_path / 'trajectory.png'
    ate = plot_trajectory(path, claims, truth, 'a walk')
    assert path.read_bytes().startswith(b'\x89PNG')
    assert (ate is None) == (truth is None)
    seconds, band = line(drawn[0], -1, 'claimed 2 sigma')
    spans = [patch.get_extents() for patch in drawn[0].axes[-1].patches]
    starts = [drawn[0].axes[-1].transData.inverted().transform(span.p0)[0] for span in spans]
    assert starts == pytest.approx([0.1 * min(lost)] if lost else [])
    if truth is not None:  # a segment between two estimates each, but not across the loss
        segments = drawn[0].axes[0].collections[0].get_paths()
        assert len(segments) == 29 - (len(lost) + 1 if lost else 0)
    estimated = np.isfinite(band)
    np.testing.assert_allclose(band[estimated], 100 * 2 * SIGMA_M)
    assert estimated.sum() == 30 - len(lost)
    if 15 in claims.estimated.nonzero()[0] and lost:  # the band breaks where the camera is lost
        assert np.isnan(seconds[10]) and seconds[11] == pytest.approx(1.5)
        assert line(drawn[0], 0, 'lost (5 frames)').shape == (2, 1)  # at the last estimate


def test_the_path_has_a_gap_where_the_camera_was_lost() -> None:
    claims = a_walk([LOST if 10 <= k < 15 else OK for k in range(30)])
    estimate = claims.trajectory()
    gap = plots._lost_between(claims, estimate.stamps_ns)
    assert np.flatnonzero(gap).tolist() == [9]  # between frames 9 and 15
    assert not plots._lost_between(a_walk([OK] * 30), claims.poses.stamps_ns).any()
    some = plots._lost_between(claims, estimate.stamps_ns[::3])
    assert np.flatnonzero(some).tolist() == [3]


def test_loops_and_the_path_as_optimised_are_drawn(tmp_path: Path, drawn: list[Figure]) -> None:
    claims = a_walk([OK] * 30)
    moved = se3.exp(np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0]))
    optimized = Trajectory(claims.poses.stamps_ns, moved @ claims.poses.T_world_cam)
    ends = optimized.T_world_cam[[[0, 20], [3, 25]], :3, 3]
    plot_trajectory(tmp_path / 'a.png', claims, None, 'a walk', optimized, ends)
    assert line(drawn[0], 0, 'optimised').shape == (2, 30)
    labels = [str(c.get_label()) for c in drawn[0].axes[0].collections]
    assert 'loops (2)' in labels
    plot_trajectory(tmp_path / 'b.png', claims, None, 'a walk', optimized, ends[:0])
    assert not any('optimised' in str(found.get_label()) for found in drawn[1].axes[0].lines)
