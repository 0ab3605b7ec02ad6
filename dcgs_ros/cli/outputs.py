# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The folder of a run: never one that is used already."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from .. import __version__
from ..core.config import Config
from ..core.errors import DcgsError
from ..datasets.source import Source
from ..evaluation.report import Accuracy, RunRecord, assess, build_report
from ..io.settings import write_config
from ..io.trajectory import write_tum
from .frames_csv import write_frames
from .host import machine, peak_rss_mb

RUNS = Path('runs')


class FolderError(DcgsError):
    """A run cannot be written where it should be."""


def refuse_used(folder: Path) -> None:
    """Raise `FolderError` where something is that a run would be mixed with."""
    if folder.is_dir():
        if any(folder.iterdir()):
            raise FolderError(f'{folder} is not empty: each run writes a folder of its own')
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


def write_outputs(
    folder: Path, record: RunRecord, config: Config, source: Source
) -> tuple[dict[str, Any], Accuracy]:
    """Write a run of at least one tracked frame, what matters most first; returns its report."""
    estimate = record.trajectory()
    write_tum(folder / 'trajectory.tum', estimate)
    write_tum(folder / 'keyframes.tum', record.keyframes())
    write_frames(folder / 'frames.csv', record)
    write_config(folder / 'config.yaml', config)
    accuracy = assess(estimate, source.groundtruth)
    try:
        from ..evaluation.plots import plot_trajectory  # matplotlib: only now, it is slow to load

        truth = source.groundtruth if accuracy.ate is not None else None
        title = f'{record.source}, {record.ablation}'
        plot_trajectory(folder / 'trajectory.png', estimate, truth, title)
    finally:
        report = build_report(record, accuracy, machine(), peak_rss_mb(), __version__)
        text = json.dumps(report, indent=2, allow_nan=False, ensure_ascii=False)
        (folder / 'report.json').write_text(text + '\n', encoding='utf-8')
    return report, accuracy
