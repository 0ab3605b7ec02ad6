# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Accuracy of the tracker: `python -m benchmarks.accuracy [--only TEXT] [--data FOLDER]`.

Synthetic scenes with several seeds, and the real sequences found in FOLDER. Prints a Markdown row
for each experiment: errors, how far they agree with what the tracker claims (`evaluation`'s
`consistency`), and counts. NEES of 1 s motion is ideally 5.3 in the median, and in the mean within
the interval behind it; 95 % of the errors of translation and rotation are within 2 sigma.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.tracking.result import TrackingState
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import Source
from dcgs_ros.evaluation.consistency import coverage_2sigma, mean_nees_bounds
from dcgs_ros.evaluation.report import Accuracy, RunRecord, TrackedFrame, assess_run

ABLATIONS = ('full', 'sigma_t', 'shared', 'shared_klt')
SYNTHETIC = {  # address without frames and seed: ablations
    'synthetic:room?': ABLATIONS,
    'synthetic:room?speed=2&': ('full',),
    'synthetic:room?sensor=d435i&': ('full',),
    'synthetic:room?sensor=ideal&': ('full',),
    'synthetic:room?sensor=d435i_measured&': ('full',),
    'synthetic:room?sensor=kinect_measured&': ('full',),
    'synthetic:zigzag?': ABLATIONS,
    'synthetic:plane?': ABLATIONS,
    'synthetic:desk?': ('full',),
    'synthetic:corridor?': ('full',),
    'synthetic:ring?': ('full',),
}
REAL = ('tum_fr3_teddy_200', 'mini_fr1_xyz_vga_120', 'tum_fr1_rpy_240')
COLUMNS = (
    'source, ablation', 'ATE cm, each seed', 'mean', 'RPE cm / deg', 'keyframes/s', 'offset ms',
    'NEES median, each seed', 'NEES mean (95 %)', 'within 2 sigma', 'silent, each seed',
    'degenerate / lost, each seed',
)  # fmt: skip
_MISSING = '-'

Experiment = tuple[str, list['Score']]


@dataclass(frozen=True)
class Score:
    """Errors and counts of one run."""

    accuracy: Accuracy
    keyframes_per_s: float
    offset_ms: float
    degenerate: int
    lost: int


def score(source: Source, frames: Sequence[RgbdFrame], ablation: str) -> Score:
    """Track `frames`, which are in memory, and compare with the source's ground truth."""
    config = override(Config(sensor=source.sensor), {'ablation': ablation})
    tracker, record = Tracker(source.camera, config), RunRecord(source.name, ablation)
    for k, frame in enumerate(frames):
        record.tracked.append(TrackedFrame(k, tracker.track(frame), 0.0, 0))
    if source.groundtruth is None:
        raise SystemExit(f'{source.name} has no ground truth')
    claims, last = record.claims(), record.tracked[-1].result
    return Score(
        assess_run(record, source.groundtruth),
        tracker.keyframes / (1e-9 * float(np.ptp(claims.poses.stamps_ns))),
        last.colour_depth_offset_ms,
        claims.states.count(TrackingState.DEGENERATE),
        claims.states.count(TrackingState.LOST),
    )


def _frames(source: Source) -> list[RgbdFrame]:
    return [frame for frame in source if isinstance(frame, RgbdFrame)]


def _synthetic(seeds: int, frames: int, only: str) -> Iterator[Experiment]:
    for address, ablations in SYNTHETIC.items():
        names = {a: f'{address.rstrip("?&")} {a}' for a in ablations}
        scores: dict[str, list[Score]] = {a: [] for a in ablations if only in names[a]}
        for seed in range(seeds if scores else 0):
            source = open_source(f'{address}frames={frames}&seed={seed}')
            images = _frames(source)
            for ablation, found in scores.items():
                found.append(score(source, images, ablation))
        for ablation, found in scores.items():
            yield names[ablation], found


def _real(data: Path, only: str) -> Iterator[Experiment]:
    for name in REAL:
        ablations = [ablation for ablation in ABLATIONS if only in f'{name} {ablation}']
        if ablations and not (data / name).is_dir():
            print(f'{name}: not in {data}')
        elif ablations:
            source = open_source(str(data / name))
            images = _frames(source)
            for ablation in ablations:
                yield f'{name} {ablation}', [score(source, images, ablation)]


def _row(name: str, scores: Sequence[Score]) -> list[str]:
    """Return the cells of an experiment; `-` for what could not be computed in any run."""
    ates = [s.accuracy.ate.rmse_cm if s.accuracy.ate else None for s in scores]
    rpes = [s.accuracy.rpe_1s for s in scores if s.accuracy.rpe_1s]
    silent = [s.accuracy.silent for s in scores]
    return [
        name,
        ' '.join(_MISSING if ate is None else f'{ate:.2f}' for ate in ates),
        _mean('.2f', [ate for ate in ates if ate is not None]),
        f'{_mean(".2f", [r.trans_rmse_cm for r in rpes])} / '
        f'{_mean(".2f", [r.rot_rmse_deg for r in rpes])}',
        f'{max(s.keyframes_per_s for s in scores):.1f}',
        _mean('.1f', [s.offset_ms for s in scores]),
        *_nees_cells([s.accuracy for s in scores]),
        ' '.join(_MISSING if s is None else str(s.count) for s in silent),
        ' '.join(f'{s.degenerate}/{s.lost}' for s in scores),
    ]


def _nees_cells(accuracies: Sequence[Accuracy]) -> tuple[str, str, str]:
    """Return the medians, the mean of all motions with its bounds, and what is in 2 sigma."""
    found = [accuracy.nees for accuracy in accuracies]
    known = [nees for nees in found if nees is not None]
    if not known:
        return _MISSING, _MISSING, _MISSING
    values, translation, rotation = (
        np.concatenate([getattr(nees, name) for nees in known])
        for name in ('values', 'translation', 'rotation')
    )
    low, high = mean_nees_bounds(sum(nees.independent for nees in known))
    return (
        ' '.join(_MISSING if n is None else f'{np.median(n.values):.1f}' for n in found),
        f'{values.mean():.1f} ({low:.1f} to {high:.1f})',
        f'{coverage_2sigma(translation):.0%} / {coverage_2sigma(rotation):.0%}',
    )


def _mean(form: str, values: Sequence[float]) -> str:
    return f'{np.mean(values):{form}}' if values else _MISSING


def _print_row(cells: Sequence[str]) -> None:
    print(f'| {" | ".join(cells)} |', flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=5)
    parser.add_argument('--frames', type=int, default=300)
    parser.add_argument('--data', type=Path, default=os.environ.get('DCGS_TEST_DATA'))
    parser.add_argument(
        '--only', default='', metavar='TEXT', help='experiments whose name contains this'
    )
    arguments = parser.parse_args()
    _print_row(COLUMNS)
    _print_row(['---'] * len(COLUMNS))
    for name, scores in _synthetic(arguments.seeds, arguments.frames, arguments.only):
        _print_row(_row(name, scores))
    for name, scores in _real(Path(arguments.data), arguments.only) if arguments.data else ():
        _print_row(_row(name, scores))


if __name__ == '__main__':
    main()
