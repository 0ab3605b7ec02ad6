# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs evaluate`: a trajectory against the true one, a run's map against its images."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

from ..core.kernels.workers import Workers, cores
from ..core.render import make_renderer
from ..core.trajectory import Trajectory
from ..datasets.open import open_source
from ..datasets.source import Source
from ..evaluation.report import Accuracy, accuracy_report, assess, with_rendering
from ..evaluation.scoring import score_map
from ..evaluation.trajectory import EvaluationError
from ..io.map_archive import MapFileError, read_map
from ..io.trajectory import read_tum
from .arguments import EvaluateArguments, UsageError
from .tables import accuracy_rows, rendering_rows, table


def execute(arguments: EvaluateArguments) -> int:
    """Print ATE and RPE, and of a run how well its map renders."""
    if arguments.estimate.is_dir():
        return _evaluate_run(arguments)
    if arguments.groundtruth is None:
        raise UsageError(f"{arguments.estimate} is no run's folder: give GROUNDTRUTH too")
    accuracy = assess(read_tum(arguments.estimate), read_tum(arguments.groundtruth))
    if accuracy.ate is None:
        raise EvaluationError(accuracy.why_no_ate)
    if arguments.json:
        _print_json(_report(accuracy))
    else:
        title = f'{arguments.estimate} against {arguments.groundtruth}'
        print(table(title, accuracy_rows(accuracy)))
    return 0


def _evaluate_run(arguments: EvaluateArguments) -> int:
    """Evaluate anew what a run has written."""
    folder, every = arguments.estimate, arguments.render_every
    if every < 0:
        raise UsageError(f'--render-every {every}: 1 or more, or 0 for none')
    estimate, source = read_tum(folder / 'trajectory.tum'), _source(arguments)
    truth = source.groundtruth
    if arguments.groundtruth is not None:
        truth = read_tum(arguments.groundtruth)
    accuracy = assess(estimate, truth)
    path = folder / 'map.dcgs'
    rendering = _rendering(path, estimate, source, every) if every and path.exists() else None
    if arguments.json:
        _print_json(_report(accuracy) | {'rendering': rendering})
    else:
        rows = [*accuracy_rows(accuracy), *rendering_rows(rendering)]
        print(table(f'{folder} against {source.name}', rows))
    return 0


def _source(arguments: EvaluateArguments) -> Source:
    """Open what the run was made from, where it was or where the arguments say."""
    path = arguments.estimate / 'report.json'
    noted: dict[str, Any] = {}
    if path.exists():
        try:
            noted = dict(json.loads(path.read_bytes()))
        except (ValueError, TypeError) as error:
            raise UsageError(f'{path} is no report: {error}') from error
    address = arguments.source or noted.get('address')
    if not isinstance(address, str):
        raise UsageError(f'{path} does not tell where the images are: give --source')
    return open_source(address, arguments.camera or noted.get('camera'))


def _rendering(path: Path, estimate: Trajectory, source: Source, every: int) -> dict[str, Any]:
    saved = read_map(path)
    try:
        with closing(Workers(cores())) as workers:
            found = score_map(saved, estimate, source, every, make_renderer(workers))
    except MapFileError as error:
        raise MapFileError(f'{path}: {error}') from None
    part: dict[str, Any] = with_rendering({}, found.scores)['rendering']
    return part


def _report(accuracy: Accuracy) -> dict[str, Any]:
    ate = accuracy.ate
    counts = {} if ate is None else {'poses': ate.poses, 'matched': ate.matched}
    return {**counts, **accuracy_report(accuracy)}


def _print_json(report: dict[str, Any]) -> None:
    print(json.dumps(report, indent=2, allow_nan=False))
