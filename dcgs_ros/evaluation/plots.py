# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Plot of a trajectory, drawn without a display and without pyplot's global state."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..core.trajectory import Trajectory
from .trajectory import AteResult, absolute_trajectory_error

_PATH_COLOR = '#1f5fa8'
_TRUTH_COLOR = '0.55'


class _Orthographic(NamedTuple):
    """An orthographic view: which world axes point right and up."""

    title: str
    right: int
    up: int
    flip_up: bool


def plot_trajectory(
    path: Path | str, estimate: Trajectory, truth: Trajectory | None = None, title: str = ''
) -> AteResult | None:
    """Plot the path from above and from the side, and its error over time, as a PNG.

    With `truth` the estimate is aligned to it and coloured by its error, and the ATE is returned;
    without, only the path is drawn. Raises `EvaluationError` as `absolute_trajectory_error` does.
    """
    ate = None if truth is None else absolute_trajectory_error(estimate, truth)
    figure = Figure(figsize=(10.0, 8.0 if ate else 5.2), dpi=120, layout='constrained')
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12, fontweight='bold')
    if truth is None or ate is None:
        axes = figure.subplots(1, 2)
        poses = estimate.T_world_cam
    else:
        grid = figure.add_gridspec(2, 2, height_ratios=(2.2, 1.0))
        axes = [figure.add_subplot(grid[0, k]) for k in (0, 1)]
        poses = ate.T_truth_estimate @ estimate.T_world_cam
        _draw_error(figure.add_subplot(grid[1, :]), ate)
    for ax, view in zip(axes, _views(poses), strict=True):
        _draw_view(ax, view, poses, estimate, truth, ate)
    if ate:
        figure.colorbar(axes[1].collections[0], ax=axes[1], label='error (cm)', shrink=0.8)
    axes[0].legend(loc='best', fontsize=8, framealpha=0.8)
    figure.savefig(path)
    return ate


def _views(poses: NDArray[np.float64]) -> tuple[_Orthographic, _Orthographic]:
    """Return a top and a side view of poses (N, 4, 4).

    Up is the world axis nearest to the mean up direction of the images: the world may be z-up
    (motion capture) or y-down (the first camera's frame).
    """
    image_up = -poses[:, :3, 1].mean(axis=0)
    up = int(np.argmax(np.abs(image_up)))
    down = bool(image_up[up] < 0)
    first, second = (up + 1) % 3, (up + 2) % 3
    if down:  # seen from the side of `up`, the right-handed order of the other two is reversed
        first, second = second, first
    extent = np.ptp(poses[:, :3, 3], axis=0)
    longer = first if extent[first] >= extent[second] else second
    return (
        _Orthographic('from above', first, second, False),
        _Orthographic('from the side', longer, up, down),
    )


def _draw_view(
    ax: Axes,
    view: _Orthographic,
    poses: NDArray[np.float64],
    estimate: Trajectory,
    truth: Trajectory | None,
    ate: AteResult | None,
) -> None:
    """Draw truth, estimate, start and end in one view."""
    flat = poses[:, [view.right, view.up], 3]
    if truth is None or ate is None:
        ax.plot(*flat.T, color=_PATH_COLOR, linewidth=1.6, label='estimate')
    else:
        first, last = np.searchsorted(truth.stamps_ns, estimate.stamps_ns[[0, -1]])
        during = slice(first, last + 1)
        true = truth.T_world_cam[during][:, [view.right, view.up], 3]
        ax.plot(*true.T, color=_TRUTH_COLOR, linewidth=3.0, alpha=0.6, label='truth')
        ax.add_collection(_colored_path(flat, estimate, ate))
    ax.plot(*flat[0], 'o', color='#2a9d3f', markersize=6, label='start', zorder=5)
    ax.plot(*flat[-1], 's', color='#c0392b', markersize=6, label='end', zorder=5)
    ax.set(title=view.title, xlabel=f'{"xyz"[view.right]} (m)', ylabel=f'{"xyz"[view.up]} (m)')
    ax.set_aspect('equal', adjustable='datalim')
    ax.margins(0.08)
    if view.flip_up:
        ax.invert_yaxis()
    ax.grid(alpha=0.25)


def _colored_path(
    flat: NDArray[np.float64], estimate: Trajectory, ate: AteResult
) -> LineCollection:
    """Colour the path (N, 2) by its error, interpolated for poses without truth."""
    errors_cm = 100 * np.interp(estimate.stamps_ns, ate.stamps_ns, ate.errors_m)
    lines = LineCollection(
        list(np.stack([flat[:-1], flat[1:]], axis=1)),
        cmap='plasma',
        norm=Normalize(0.0, max(ate.max_cm, 1e-9)),
        linewidth=1.8,
        label='estimate',
        zorder=3,
    )
    lines.set_array(0.5 * (errors_cm[:-1] + errors_cm[1:]))
    return lines


def _draw_error(ax: Axes, ate: AteResult) -> None:
    """Plot the error of each pose over time."""
    seconds = (ate.stamps_ns - ate.stamps_ns[0]) * 1e-9
    errors_cm = 100 * ate.errors_m
    ax.fill_between(seconds, errors_cm, color=_PATH_COLOR, alpha=0.15, linewidth=0)
    ax.plot(seconds, errors_cm, color=_PATH_COLOR, linewidth=1.3)
    ax.axhline(ate.rmse_cm, color='#c0392b', linewidth=1.0, linestyle='--', label='RMSE')
    ax.legend(loc='upper right', fontsize=8, framealpha=0.8)
    ax.set(
        title=f'ATE RMSE {ate.rmse_cm:.2f} cm (mean {ate.mean_cm:.2f}, median '
        f'{ate.median_cm:.2f}, max {ate.max_cm:.2f}; {ate.matched} of {ate.poses} poses)',
        xlabel='time (s)',
        ylabel='error (cm)',
        xlim=(0.0, max(float(seconds[-1]), 1e-9)),
        ylim=(0.0, 1.08 * max(ate.max_cm, 1e-9)),
    )
    ax.grid(alpha=0.25)
