# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Faults put into sequences: `python -m benchmarks.faults [--data FOLDER] [--only TEXT]`.

Synthetic rooms, and the real sequences found in FOLDER, go through what `dcgs run` tracks with,
once without a fault and once with each. Prints a table a sequence: when the state told of the
fault, how long after its end the pose was right again, and how many frames were silent: `ok`, with
an error over the last second of more than 10 cm or 5 times the claimed 3 sigma.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from dcgs_ros.cli.run.pipeline import NoMapping, Pipeline
from dcgs_ros.cli.run.progress import Progress
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.loop_closing import ClosingInLockstep
from dcgs_ros.core.tracking.result import TrackResult
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import Source
from dcgs_ros.evaluation.report import RunRecord, SkippedFrame, TrackedFrame

from .fault_scores import Reference, Run, Score, score
from .frame_faults import FAULTS, Clip, Fault, Faulted, Shot

SYNTHETIC = ('synthetic:room?', 'synthetic:room?sensor=d435i&')  # without the seed
REAL = ('tum_fr3_teddy_200', 'mini_fr1_xyz_vga_120', 'tum_fr1_rpy_240')
SHORT = 'synthetic:room?frames=150&'
_ELSEWHERE = {True: 'synthetic:zigzag?frames=45', False: 'synthetic:room?frames=45&seed=7'}
NO_FAULT = Fault('no fault', 'the sequence as it is', 0.0, lambda clip, *_: _whole(clip))


def _whole(clip: Clip) -> Faulted:
    return Faulted(list(clip.shots), 0, 0)


class _Silence(Progress):
    """Prints nothing."""

    def __init__(self) -> None:
        """Show no bar."""

    def tracked(self, frame: TrackedFrame) -> None:
        """Ignore it."""

    def skipped(self, frame: SkippedFrame) -> None:
        """Ignore it."""


def shots_of(source: Source) -> tuple[Shot, ...]:
    """Read all frames that lie within the ground truth, which is interpolated."""
    if source.groundtruth is None:
        raise SystemExit(f'{source.name} has no ground truth')
    truth = source.groundtruth
    first_ns, last_ns = truth.stamps_ns[[0, -1]]
    frames = [
        frame for frame in source
        if isinstance(frame, RgbdFrame) and first_ns <= frame.stamp_ns <= last_ns
    ]  # fmt: skip
    stamps_ns = np.array([frame.stamp_ns for frame in frames])
    poses = interpolated(truth, stamps_ns)
    times_s = (stamps_ns - stamps_ns[0]) * 1e-9
    return tuple(Shot(frames[k], float(times_s[k]), poses[k], k) for k in range(len(frames)))


def interpolated(truth: Trajectory, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the true poses (N, 4, 4) at stamps (N,) within the trajectory."""
    known_s, wanted_s = ((s - truth.stamps_ns[0]) * 1e-9 for s in (truth.stamps_ns, stamps_ns))
    poses = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    poses[:, :3, :3] = Slerp(known_s, Rotation.from_matrix(truth.T_world_cam[:, :3, :3]))(
        wanted_s
    ).as_matrix()
    for axis in range(3):
        poses[:, axis, 3] = np.interp(wanted_s, known_s, truth.T_world_cam[:, axis, 3])
    return poses


def clip_of(source: Source) -> Clip:
    """Read a sequence, and some frames of a scene that it does not show."""
    other = open_source(_ELSEWHERE[source.name.startswith('synthetic:room')])
    return Clip(shots_of(source), source.camera, source.sensor, shots_of(other))


def track(camera: PinholeCamera, config: Config, shots: Sequence[Shot]) -> Run:
    """Track shots as `dcgs run` does, without a mapper."""
    record = RunRecord('faults', config.ablation)
    tracker, mapping = Tracker(camera, config), NoMapping()
    closing = ClosingInLockstep(tracker, mapping)
    pipeline = Pipeline(tracker, mapping, closing, None, online=False)
    pipeline.process([shot.item for shot in shots], record, _Silence(), lambda: False)
    results: list[TrackResult | None] = [None] * len(shots)
    for frame in record.tracked:
        results[frame.index] = frame.result
    return Run(shots, results)


def scores(clip: Clip, faults: Sequence[Fault], seed: int) -> Iterator[tuple[Fault, Score]]:
    """Track the sequence without a fault and with each; yield what came of them."""
    config, clean = Config(sensor=clip.sensor), _whole(clip)
    run = track(clip.camera, config, clean.shots)
    reference = Reference.of(run)
    everywhere = np.ones(len(clip.shots), np.bool_)
    yield NO_FAULT, score(NO_FAULT, clean, run, reference, everywhere)
    for fault in faults:
        faulted = fault.put_into(clip, seed)
        run = track(clip.camera, config, faulted.shots)
        seen = clip.seen_before(faulted.shots, faulted.begin)
        yield fault, score(fault, faulted, run, reference, seen)


def _row(fault: Fault, found: Score) -> str:
    detected = '   no      ' if found.detected_s is None else f'  yes {found.detected_s:5.2f}'
    not_recovered = 'no' if found.seen else 'unseen'
    recovered = not_recovered if found.recovered_s is None else f'{found.recovered_s:.2f}'
    states = ' '.join(f'{state} {n}' for state, n in sorted(found.states.items()))
    return (
        f'{fault.name:24s} {detected} {recovered:>9s} {found.silent:6d} {found.silent_10_cm:6d}'
        f' {found.absolute:8d} {found.worst_cm:8.1f}   {states}'
    )


def _table(name: str, clip: Clip, faults: Sequence[Fault], seed: int) -> Counter[str]:
    """Print a sequence's table; return its sums."""
    print(f'\n{name}: {len(clip.shots)} frames')
    print(
        f'{"fault":24s}  detected s recovered silent >10 cm absolute worst cm   states, in frames',
        flush=True,
    )
    sums: Counter[str] = Counter()
    for fault, found in scores(clip, faults, seed):
        print(_row(fault, found), flush=True)
        if fault is not NO_FAULT:
            sums += Counter(
                faults=1, detected=found.detected_s is not None,
                recovered=found.recovered_s is not None,
                seen=found.seen or found.recovered_s is not None, silent=found.silent,
                silent_10_cm=found.silent_10_cm, absolute=found.absolute,
                silent_kinds=found.silent > 0,
            )  # fmt: skip
    return sums


def _addresses(short: bool, seeds: int, data: Path | None) -> Iterator[tuple[str, int]]:
    """Yield the addresses of the sequences and the seeds of the faults."""
    for address in (SHORT,) if short else SYNTHETIC:
        for seed in range(seeds):
            yield f'{address}seed={seed}', seed
    if short or data is None:
        return
    for name in REAL:
        if (data / name).is_dir():
            yield str(data / name), 0
        else:
            print(f'{name}: not in {data}')


def main() -> None:
    """Print the tables, and the sums over all of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--only', default='', metavar='TEXT', help='faults with it in their name')
    parser.add_argument('--source', default='', metavar='TEXT', help='likewise, sequences')
    parser.add_argument('--seeds', type=int, default=1, help='of each synthetic sequence')
    parser.add_argument('--data', type=Path, default=os.environ.get('DCGS_TEST_DATA'))
    parser.add_argument('--short', action='store_true', help='one sequence of 5 s')
    parser.add_argument('--list', action='store_true', help='say what the faults are')
    arguments = parser.parse_args()
    faults = [fault for fault in FAULTS if arguments.only in fault.name]
    if arguments.list:
        print('\n'.join(f'{fault.name:24s}{fault.what}' for fault in faults))
        return
    data = None if arguments.data is None else Path(arguments.data)
    sums: Counter[str] = Counter()
    for address, seed in _addresses(arguments.short, arguments.seeds, data):
        if arguments.source in address:
            clip = clip_of(open_source(address))
            sums += _table(address.rsplit('/', 1)[-1], clip, faults, seed)
    print(
        f'\n{sums["faults"]} faults: {sums["detected"]} detected; recovered {sums["recovered"]} '
        f'of {sums["seen"]} that end where the camera had been; '
        f'{sums["silent_kinds"]} with silent frames: {sums["silent"]}, of which '
        f'{sums["silent_10_cm"]} by more than 10 cm; {sums["absolute"]} wrong in the map'
    )


if __name__ == '__main__':
    main()
