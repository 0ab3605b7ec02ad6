# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs evaluate`: compare a trajectory with ground truth, a run's map with its images."""

from __future__ import annotations

import json
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.kernels.workers import Workers, cores
from ..core.render import make_renderer
from ..core.trajectory import Trajectory
from ..datasets.open import open_source
from ..datasets.source import Source
from ..evaluation.consistency import silent_frames
from ..evaluation.report import Accuracy, accuracy_report, assess, with_rendering
from ..evaluation.scoring import score_map
from ..evaluation.trajectory import EvaluationError, coverage
from ..io.map_archive import MapFileError, read_map
from ..io.trajectory import read_tum
from .arguments import EvaluateArguments, UsageError
from .frames_file import FrameClaims, read_frames
from .tables import accuracy_rows, rendering_rows, table


def execute(arguments: EvaluateArguments) -> int:
    """Print a trajectory's errors, and a run's claims and rendering; return the exit status."""
    if arguments.estimate.is_dir():
        return _evaluate_run(arguments)
    if arguments.groundtruth is None:
        raise UsageError(f"{arguments.estimate} is not a run's folder: give GROUNDTRUTH too")
    accuracy = assess(read_tum(arguments.estimate), _read_truth(arguments.groundtruth))
    if accuracy.ate is None:
        raise EvaluationError(accuracy.why_no_ate)
    if arguments.json:
        _print_json(_report(accuracy))
    else:
        title = f'{arguments.estimate} against {arguments.groundtruth}'
        print(table(title, accuracy_rows(accuracy)))
    return 0


def _evaluate_run(arguments: EvaluateArguments) -> int:
    """Evaluate the trajectory and the map in a run's folder."""
    folder, every = arguments.estimate, arguments.render_every
    if every < 0:
        raise UsageError(f'--render-every {every}: 1 or more, or 0 for none')
    estimate, source = read_tum(folder / 'trajectory.tum'), _source(arguments)
    truth = source.groundtruth
    if arguments.groundtruth is not None:
        truth = _read_truth(arguments.groundtruth)
    accuracy, frames = assess(estimate, truth), folder / 'frames.csv'
    if truth is not None and frames.exists():
        accuracy = _with_claims(accuracy, estimate, read_frames(frames), truth)
    path = folder / 'map.dcgs'
    rendering = _rendering(path, estimate, source, every) if every and path.exists() else None
    if arguments.json:
        _print_json(_report(accuracy) | {'rendering': rendering})
    else:
        rows = [*accuracy_rows(accuracy), *rendering_rows(rendering)]
        print(table(f'{folder} against {source.name}', rows))
    return 0


def _read_truth(path: Path) -> Trajectory:
    """Read ground truth; say on stderr what of it cannot be used."""
    left_out: list[str] = []
    truth = read_tum(path, left_out)
    for line in left_out:
        print(f'dcgs: {line}', file=sys.stderr)
    return truth


def _source(arguments: EvaluateArguments) -> Source:
    """Open the sequence that the arguments or the run's report name."""
    path = arguments.estimate / 'report.json'
    report: dict[str, Any] = {}
    if path.exists():
        try:
            report = dict(json.loads(path.read_bytes()))
        except (ValueError, TypeError) as error:
            raise UsageError(f'{path} is not a report: {error}') from error
    address = arguments.source or report.get('address')
    if not isinstance(address, str):
        raise UsageError(f'{path} does not name the source of the images: give --source')
    return open_source(address, arguments.camera or report.get('camera'))


def _with_claims(
    accuracy: Accuracy, estimate: Trajectory, frames: FrameClaims, truth: Trajectory
) -> Accuracy:
    """Add what frames.csv allows: coverage and silent frames. NEES needs whole covariances."""
    _, own, theirs = np.intersect1d(estimate.stamps_ns, frames.stamps_ns, return_indices=True)
    poses = Trajectory(estimate.stamps_ns[own], estimate.T_world_cam[own])
    states = [frames.states[k] for k in theirs]
    silent = silent_frames(poses, states, frames.sigmas_m[theirs], truth, frames.worlds[theirs])
    return replace(
        accuracy,
        coverage=coverage(estimate.stamps_ns, frames.all_ns, truth),
        silent=silent if silent.judged.any() else None,
    )


def _rendering(path: Path, estimate: Trajectory, source: Source, every: int) -> dict[str, Any]:
    """Return the part `rendering` of a report. Raises `MapFileError` that names the file."""
    saved = read_map(path)
    try:
        with closing(Workers(cores())) as workers:
            found = score_map(saved, estimate, source, every, make_renderer(workers))
    except MapFileError as error:
        raise MapFileError(f'{path}: {error}') from None
    part: dict[str, Any] = with_rendering({}, found.scores)['rendering']
    return part


def _report(accuracy: Accuracy) -> dict[str, Any]:
    """Return the errors as in a report, with the numbers of poses and of matched poses."""
    ate = accuracy.ate
    counts = {} if ate is None else {'poses': ate.poses, 'matched': ate.matched}
    return {**counts, **accuracy_report(accuracy)}


def _print_json(report: dict[str, Any]) -> None:
    print(json.dumps(report, indent=2, allow_nan=False))
