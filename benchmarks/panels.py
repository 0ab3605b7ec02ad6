# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Curves over something that goes on, one panel below the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from numpy.typing import NDArray

Panel = tuple[str, Mapping[str, NDArray]]  # label of the axis, curves by their names


def draw_panels(
    path: Path, along: tuple[str, NDArray], panels: Sequence[Panel], title: str = ''
) -> None:
    """Draw the curves over `along`, from zero, into a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 6.0), dpi=120, layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(panels), 1, sharex=True)
    label, x = along
    for ax, (ylabel, curves) in zip(axes, panels, strict=True):
        for name, y in curves.items():
            ax.plot(x, y, label=name)
        ax.set(ylabel=ylabel)
        ax.set_ylim(bottom=0)
        ax.legend(fontsize=8)
        ax.grid(alpha=0.25)
    axes[0].set(title=title)
    axes[-1].set(xlabel=label)
    figure.savefig(path)
