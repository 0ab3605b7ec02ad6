# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Runs `dcgs run` in the test's process and returns its results."""

from __future__ import annotations

import csv
import io
import json
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dcgs_ros.cli.main import main
from dcgs_ros.core.camera import PinholeCamera

TRACKS = {
    'trajectory.tum', 'trajectory_optimized.tum', 'keyframes.tum', 'frames.csv', 'config.yaml',
    'report.json',
    'trajectory.png',
}  # fmt: skip
MAPS = {'map.ply', 'map.dcgs', 'views.png'}
SMALL_CAMERA = PinholeCamera(160, 120, 131.25, 131.25, 79.5, 59.5)
SMALL_FRAMES = 10
SMALL_ADDRESS = f'synthetic:room?frames={SMALL_FRAMES}'
# Sampling dense enough for small images, a view every third frame, few steps.
SMALL_ROOM = (
    SMALL_ADDRESS, '--render-every', '2', '--set', 'mapping.spawn_stride_px=2',
    'mapping.view_interval=3', 'mapping.steps_per_frame=2',
    'mapping.final_steps=12',
)  # fmt: skip


WALL = ('--set', 'cloud.stride_px=2', 'keyframes.spawn_stride_px=2')  # sampling for 64x48 pixels


@dataclass(frozen=True)
class Run:
    """Exit status, output and folder of `dcgs run`."""

    folder: Path
    status: int
    out: str
    err: str

    def files(self) -> set[str]:
        return {path.name for path in self.folder.iterdir()}

    def report(self) -> dict[str, Any]:
        def refuse(constant: str) -> None:
            raise AssertionError(f'{constant} is not JSON')

        text = (self.folder / 'report.json').read_text()
        report = json.loads(text, parse_constant=refuse)
        assert isinstance(report, dict)
        return report

    def frames(self) -> list[dict[str, str]]:
        with (self.folder / 'frames.csv').open(newline='') as file:
            return list(csv.DictReader(file))


def held_still(folder: Path) -> Path:
    """Give all frames of a `tum_folder` the depth of its first one: a camera before a wall."""
    first = (folder / 'depth' / '0.png').read_bytes()
    for path in (folder / 'depth').iterdir():
        path.write_bytes(first)
    return folder


def lines_of(out: str) -> dict[str, str]:
    """Return the table's second column by its first."""
    pairs = [line.strip().partition('  ') for line in out.splitlines()[1:]]
    return {label: text.strip() for label, _, text in pairs}


def run_into(folder: Path, *words: str) -> Run:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        status = main(['run', *words, '--out', str(folder)])
    return Run(folder, status, out.getvalue(), err.getvalue())
