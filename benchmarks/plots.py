# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Plots of quantities over a common axis, such as time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]  # (N,)
Plot = tuple[str, Mapping[str, Values]]  # label of the y axis, curves by name


def draw_plots(path: Path, x: tuple[str, Values], plots: Sequence[Plot], title: str = '') -> None:
    """Draw the plots one below the other over `x` (label, values), y from zero, as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 6.0), dpi=120, layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(plots), 1, sharex=True)
    for ax, (label, curves) in zip(axes, plots, strict=True):
        for name, y in curves.items():
            ax.plot(x[1], y, label=name)
        ax.set(ylabel=label)
        ax.set_ylim(bottom=0)
        ax.legend(fontsize=8)
        ax.grid(alpha=0.25)
    axes[0].set(title=title)
    axes[-1].set(xlabel=x[0])
    figure.savefig(path)
