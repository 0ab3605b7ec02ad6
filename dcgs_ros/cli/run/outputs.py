# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The files that a run writes: trajectories, frames, configuration, plot and report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ...core.config.stages import Config
from ...core.trajectory import Trajectory
from ...evaluation.report import RunRecord
from ...io.config_file import write_config
from ...io.trajectory import write_tum
from ...io.whole_files import replacing
from ..frames_file import write_frames


def write_tracks(folder: Path, record: RunRecord, config: Config) -> None:
    """Write the trajectory, the keyframes, a line per frame, and the configuration as used."""
    write_tum(folder / 'trajectory.tum', record.trajectory())
    write_tum(folder / 'keyframes.tum', record.keyframes())
    write_frames(folder / 'frames.csv', record)
    write_config(folder / 'config.yaml', config)


def write_optimized(folder: Path, record: RunRecord) -> None:
    """Write the trajectory as it is known at the end, if there was a back end."""
    optimized = record.optimized()
    if optimized is not None:
        write_tum(folder / 'trajectory_optimized.tum', optimized)


def write_plot(folder: Path, record: RunRecord, truth: Trajectory | None) -> None:
    """Draw the trajectory, aligned to the ground truth if there is one to compare with."""
    from ...evaluation.plots import plot_trajectory  # imports matplotlib, which is slow to load

    title = f'{record.source}, {record.ablation}'
    optimized = record.optimized()
    plot_trajectory(
        folder / 'trajectory.png', record.claims(), truth, title, optimized, record.loop_ends()
    )


def write_report(folder: Path, report: dict[str, Any]) -> None:
    """Write the report, replacing an earlier one of the same run."""
    text = json.dumps(report, indent=2, allow_nan=False, ensure_ascii=False)
    with replacing(folder / 'report.json') as path:
        path.write_text(text + '\n', encoding='utf-8')
