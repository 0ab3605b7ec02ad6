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

from ..core import se3
from ..core.tracking.result import TrackingState
from ..core.trajectory import Trajectory
from .consistency import Claims
from .states import stretches
from .trajectory import AteResult, absolute_trajectory_error

_PATH_COLOR = '#1f5fa8'
_TRUTH_COLOR = '0.55'
_CLAIM_COLOR = '#e07b00'
_OPTIMIZED_COLOR = '#111111'
_LOOP_COLOR = '#2a9d3f'
_STATE_COLORS = {
    TrackingState.DEGENERATE: '#d4a200',
    TrackingState.LOST: '#c0392b',
    TrackingState.RELOCALISED: '#8e44ad',
}
_SIGMAS = 2.0  # of the band
_BAND_LIMIT = 2.0  # times the largest error: more of the band is not shown
_LEAST_TOP_CM = 0.1  # of the axis, for a band that is zero


class _Orthographic(NamedTuple):
    """An orthographic view: which world axes point right and up."""

    title: str
    right: int
    up: int
    flip_up: bool


def plot_trajectory(
    path: Path | str,
    claims: Claims,
    truth: Trajectory | None = None,
    title: str = '',
    optimized: Trajectory | None = None,
    loops: NDArray[np.float64] | None = None,
) -> AteResult | None:
    """Plot the path from above and from the side, and error and claims over time, as a PNG.

    States other than `ok` are marked. Lost frames, of which there is no estimate, leave a gap in
    the path. With `truth` the estimate is aligned to it and coloured by its error, and the ATE is
    returned. The path as `optimized` at the end, and the `loops` (L, 2, 3) that were closed, both
    in the world of the estimate, are drawn where there are loops. At least one frame is not lost.
    Raises `EvaluationError` as
    `absolute_trajectory_error` does.
    """
    estimate = claims.trajectory()
    ate = None if truth is None else absolute_trajectory_error(estimate, truth)
    figure = Figure(figsize=(10.0, 8.0), dpi=120, layout='constrained')
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12, fontweight='bold')
    grid = figure.add_gridspec(2, 2, height_ratios=(2.2, 1.0))
    axes = [figure.add_subplot(grid[0, k]) for k in (0, 1)]
    poses = estimate.T_world_cam if ate is None else ate.T_truth_estimate @ estimate.T_world_cam
    for ax, view in zip(axes, _views(poses), strict=True):
        _draw_view(ax, view, poses, claims, truth, ate)
        if optimized is not None and loops is not None and len(loops):
            T = np.eye(4) if ate is None else ate.T_truth_estimate
            _draw_loops(
                ax, view, T @ optimized.T_world_cam, se3.transform(T, loops.reshape(-1, 3))
            )
    if ate:
        figure.colorbar(axes[1].collections[0], ax=axes[1], label='error (cm)', shrink=0.8)
    axes[0].legend(loc='best', fontsize=8, framealpha=0.8)
    _draw_over_time(figure.add_subplot(grid[1, :]), claims, ate)
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
    claims: Claims,
    truth: Trajectory | None,
    ate: AteResult | None,
) -> None:
    """Draw truth, estimate, states, start and end in one view; `poses` (N, 4, 4) are estimated."""
    flat, stamps = poses[:, [view.right, view.up], 3], claims.trajectory().stamps_ns
    if truth is None or ate is None:
        ax.plot(
            *_broken(claims, stamps, *flat.T)[1:],
            color=_PATH_COLOR,
            linewidth=1.6,
            label='estimate',
        )
    else:
        first, last = np.searchsorted(truth.stamps_ns, stamps[[0, -1]])
        during = slice(first, last + 1)
        true = truth.T_world_cam[during][:, [view.right, view.up], 3]
        ax.plot(*true.T, color=_TRUTH_COLOR, linewidth=3.0, alpha=0.6, label='truth')
        ax.add_collection(_colored_path(flat, claims, ate))
    _mark_states(ax, flat, claims)
    ax.plot(*flat[0], 'o', color='#2a9d3f', markersize=6, label='start', zorder=5)
    ax.plot(*flat[-1], 's', color='0.15', markersize=6, label='end', zorder=5)
    ax.set(title=view.title, xlabel=f'{"xyz"[view.right]} (m)', ylabel=f'{"xyz"[view.up]} (m)')
    ax.set_aspect('equal', adjustable='datalim')
    ax.margins(0.08)
    if view.flip_up:
        ax.invert_yaxis()
    ax.grid(alpha=0.25)


def _draw_loops(
    ax: Axes, view: _Orthographic, poses: NDArray[np.float64], ends: NDArray[np.floating]
) -> None:
    """Draw the optimised path (N, 4, 4), and the loops by their ends (2 L, 3)."""
    flat, pairs = poses[:, [view.right, view.up], 3], ends[:, [view.right, view.up]]
    ax.plot(*flat.T, color=_OPTIMIZED_COLOR, linewidth=0.9, label='optimised', zorder=3)
    lines = LineCollection(
        list(pairs.reshape(-1, 2, 2)), colors=_LOOP_COLOR, linewidth=0.8, zorder=2,
        label=f'loops ({len(pairs) // 2})',
    )  # fmt: skip
    ax.add_collection(lines)


def _mark_states(ax: Axes, flat: NDArray[np.float64], claims: Claims) -> None:
    """Draw a dot at each frame that is not `ok`, and a cross where the camera was lost."""
    place = np.maximum(np.cumsum(claims.in_map) - 1, 0)  # of lost frames: of the last estimate
    for state, color in _STATE_COLORS.items():
        frames = [k for k, found in enumerate(claims.states) if found is state]
        if not frames:
            continue
        where, lost = flat[np.unique(place[frames])], state is TrackingState.LOST
        marker, size, width = ('X', 9, 1.0) if lost else ('o', 4, 0.0)
        ax.plot(
            *where.T, marker, color=color, markersize=size, markeredgecolor='white',
            markeredgewidth=width, label=f'{state.value} ({len(frames)} frames)',
            zorder=6 if lost else 4,
        )  # fmt: skip


def _colored_path(flat: NDArray[np.float64], claims: Claims, ate: AteResult) -> LineCollection:
    """Colour the path (N, 2) by its error, interpolated for poses without truth."""
    stamps = claims.trajectory().stamps_ns
    errors_cm = 100 * np.interp(stamps, ate.stamps_ns, ate.errors_m)
    joined = ~_lost_between(claims, stamps)
    lines = LineCollection(
        list(np.stack([flat[:-1], flat[1:]], axis=1)[joined]),
        cmap='plasma',
        norm=Normalize(0.0, max(ate.max_cm, 1e-9)),
        linewidth=1.8,
        label='estimate',
        zorder=3,
    )
    lines.set_array((0.5 * (errors_cm[:-1] + errors_cm[1:]))[joined])
    return lines


def _draw_over_time(ax: Axes, claims: Claims, ate: AteResult | None) -> None:
    """Plot the error of each pose, what is claimed of it, and the states, over time."""
    stamps = claims.poses.stamps_ns
    kept = claims.in_map
    band_cm = 100 * _SIGMAS * claims.world_sigmas_m[kept]
    top_cm = float(band_cm.max())
    if ate is not None:
        top_cm = max(ate.max_cm, min(top_cm, _BAND_LIMIT * ate.max_cm))
    _draw_spans(ax, claims)
    seconds, band = _broken(claims, stamps[kept], band_cm)
    ax.fill_between(seconds, band, color=_CLAIM_COLOR, alpha=0.25, linewidth=0)
    ax.plot(
        seconds, band, color=_CLAIM_COLOR, linewidth=0.8,
        label='claimed 2 sigma of the position in the world',
    )  # fmt: skip
    if ate is not None:
        seconds, errors = _broken(claims, ate.stamps_ns, 100 * ate.errors_m)
        ax.plot(seconds, errors, color=_PATH_COLOR, linewidth=1.4, label='error, aligned')
        ax.axhline(ate.rmse_cm, color='0.3', linewidth=1.0, linestyle='--', label='RMSE')
        ax.set_title(
            f'ATE RMSE {ate.rmse_cm:.2f} cm (mean {ate.mean_cm:.2f}, median {ate.median_cm:.2f}, '
            f'max {ate.max_cm:.2f}; {ate.matched} poses of {len(stamps)} frames)'
        )
    ax.legend(loc='upper left', fontsize=8, framealpha=0.8, ncols=6)
    ax.set(
        xlabel='time (s)',
        ylabel='cm',
        xlim=(0.0, max(1e-9 * float(stamps[-1] - stamps[0]), 1e-9)),
        ylim=(0.0, 1.25 * max(top_cm, _LEAST_TOP_CM)),  # room for the legend
    )
    ax.grid(alpha=0.25)


def _draw_spans(ax: Axes, claims: Claims) -> None:
    """Colour the time in which the state was not `ok`."""
    start_ns, named = claims.poses.stamps_ns[0], set()
    for stretch in stretches(claims.poses.stamps_ns, claims.states):
        if stretch.state in _STATE_COLORS:
            ends = (1e-9 * (t - start_ns) for t in (stretch.start_ns, stretch.end_ns))
            color, name = _STATE_COLORS[stretch.state], stretch.state.value
            label = '_' if name in named else name
            ax.axvspan(*ends, color=color, alpha=0.25, linewidth=1.0, label=label, zorder=0)
            named.add(name)


def _broken(
    claims: Claims, stamps_ns: NDArray[np.int64], *columns: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Return seconds since the first frame and columns (N,), with NaN where the camera was lost.

    A line through them has gaps there.
    """
    seconds = 1e-9 * (stamps_ns - claims.poses.stamps_ns[0])
    gaps = np.flatnonzero(_lost_between(claims, stamps_ns)) + 1
    return [np.insert(np.asarray(c, np.float64), gaps, np.nan) for c in (seconds, *columns)]


def _lost_between(claims: Claims, stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return (N - 1,) whether the camera was lost between two of the stamps (N,)."""
    lost_ns = claims.poses.stamps_ns[~claims.in_map]
    return np.diff(np.searchsorted(lost_ns, stamps_ns)) > 0
