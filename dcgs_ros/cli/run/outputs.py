# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The folder of a run: never one that is used already."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

from ...core.config.stages import Config
from ...core.errors import DcgsError
from ...core.trajectory import Trajectory
from ...evaluation.report import RunRecord
from ...io.config_file import write_config
from ...io.trajectory import write_tum
from .frames_csv import write_frames

RUNS = Path('runs')


class FolderError(DcgsError):
    """A run cannot be written where it should be."""


def refuse_used(folder: Path) -> None:
    """Raise `FolderError` where something is that a run would be mixed with."""
    if folder.is_dir():
        if any(folder.iterdir()):
            raise FolderError(f'{folder} is not empty: a new folder is needed')
    elif folder.exists():
        raise FolderError(f'{folder} is a file, not a folder')


def create_folder(folder: Path | None, name: str) -> Path:
    """Create `folder`, or the first of runs/NAME-1, -2, ... that does not exist."""
    if folder is not None:
        refuse_used(folder)
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    stem = re.sub(r'[^\w.]+', '-', name).strip('-.') or 'run'
    number = 1
    while True:
        folder = RUNS / f'{stem}-{number}'
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            number += 1
        else:
            return folder


def write_tracks(folder: Path, record: RunRecord, config: Config) -> None:
    """Write what the tracker did, and what it was told."""
    write_tum(folder / 'trajectory.tum', record.trajectory())
    write_tum(folder / 'keyframes.tum', record.keyframes())
    write_frames(folder / 'frames.csv', record)
    write_config(folder / 'config.yaml', config)


def write_plot(folder: Path, record: RunRecord, truth: Trajectory | None) -> None:
    """Draw the trajectory, against the truth where it can be compared."""
    from ...evaluation.plots import plot_trajectory  # matplotlib: only now, it is slow to load

    title = f'{record.source}, {record.ablation}'
    plot_trajectory(folder / 'trajectory.png', record.trajectory(), truth, title)


def write_report(folder: Path, report: dict[str, Any]) -> None:
    """Write the report, over an earlier one of the same run."""
    text = json.dumps(report, indent=2, allow_nan=False, ensure_ascii=False)
    temporary = folder / f'.report.json.{os.getpid()}.tmp'
    temporary.write_text(text + '\n', encoding='utf-8')
    os.replace(temporary, folder / 'report.json')
