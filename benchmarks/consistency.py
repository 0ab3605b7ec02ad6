# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Whether covariances are honest: `python -m benchmarks.consistency [--seeds 5] [--data FOLDER]`.

`--ablation` takes those of `dcgs run`; with `--seeds 0` there are the real sequences only.

NEES of the motion over a second, e^T P^-1 e with e = log(inv(dT_true) dT) and P the covariances of
both ends in the frame of the later one: 6 on average if they are right, 5.35 in the median.

Motion capture is not exact: about 1 mm and 0.5 degrees (TUM), and its clock lies beside the
camera's. The columns `truth` count that: P with the truth's covariance, truth read at its stamps
plus the constant offset for which rotations over 0.1 s agree best. `raw` does neither.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from dcgs_ros.core import se3
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.open import open_source

SYNTHETIC = (
    'synthetic:room?',
    'synthetic:room?speed=2&',
    'synthetic:room?sensor=d435i&',
    'synthetic:zigzag?',
    'synthetic:plane?',
)
REAL = ('tum_fr3_teddy_200', 'mini_fr1_xyz_vga_120', 'tum_fr1_rpy_240')
_TOLERANCE_NS = 20_000_000
_TRUTH = np.diag(np.square(np.repeat([0.001 / np.sqrt(3), np.radians(0.5) / np.sqrt(3)], 3)))
_OFFSETS_NS = range(-40_000_000, 40_000_001, 2_000_000)


@dataclass(frozen=True)
class Score:
    """Consistency of one run."""

    nees: NDArray[np.float64]  # (M,)
    blocks: NDArray[np.float64]  # (M, 2) of translation and of rotation alone, with 3 dof
    within: float  # share of the components within 2 sigma
    worst: float  # largest translation error in units of 3 sigma claimed at the end, where `ok`


def score(
    results: list[TrackResult], truth: Trajectory, offset_ns: int, noise: NDArray[np.float64]
) -> Score:
    """Compare motions over 1 s, of tracked frames, with a truth of covariance `noise`."""
    T_true = interpolated(truth, np.array([r.stamp_ns for r in results]) + offset_ns)
    rows = []
    for i, j in _pairs(results, 1_000_000_000):
        e, Ad = _error(results, T_true, i, j)
        P = results[j].covariance + Ad @ results[i].covariance @ Ad.T + noise + Ad @ noise @ Ad.T
        blocks = [e[k] @ np.linalg.solve(P[k, k], e[k]) for k in (slice(3), slice(3, 6))]
        sigma_m = np.sqrt(np.trace(results[j].covariance[:3, :3]))
        ok = results[j].state is TrackingState.OK
        rows.append(
            [
                e @ np.linalg.solve(P, e), *blocks, np.mean(e * e < 4 * np.diag(P)),
                ok * np.linalg.norm(e[:3]) / (3 * sigma_m),
            ]
        )  # fmt: skip
    table = np.array(rows)
    return Score(table[:, 0], table[:, 1:3], float(table[:, 3].mean()), float(table[:, 4].max()))


def clock_offset_ns(results: list[TrackResult], truth: Trajectory) -> int:
    """Return the offset of the truth's stamps for which rotations over 0.1 s agree best."""
    pairs = _pairs(results, 100_000_000)
    stamps_ns = np.array([r.stamp_ns for r in results])

    def cost(offset_ns: int) -> float:
        T_true = interpolated(truth, stamps_ns + offset_ns)
        return sum(float(np.square(_error(results, T_true, i, j)[0][3:]).sum()) for i, j in pairs)

    return min(_OFFSETS_NS, key=cost)


def interpolated(truth: Trajectory, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the true poses (N, 4, 4) at stamps, between those that are known."""
    known = truth.stamps_ns
    at = np.clip(stamps_ns, known[0], known[-1]) - known[0]
    T = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    rotations = Rotation.from_matrix(truth.T_world_cam[:, :3, :3])
    T[:, :3, :3] = Slerp(known - known[0], rotations)(at).as_matrix()
    for k in range(3):
        T[:, k, 3] = np.interp(at, known - known[0], truth.T_world_cam[:, k, 3])
    return T


def _pairs(results: list[TrackResult], interval_ns: int) -> list[tuple[int, int]]:
    """Return indices of tracked frames that are an interval apart."""
    stamps_ns = np.array([r.stamp_ns for r in results])
    lost = np.cumsum([r.state is TrackingState.LOST for r in results])
    pairs = []
    for j, stamp_ns in enumerate(stamps_ns):
        gaps = np.abs(stamps_ns - (stamp_ns - interval_ns))
        i = int(gaps.argmin())
        if gaps[i] < _TOLERANCE_NS and lost[i] == lost[j] and (i == 0 or lost[i] == lost[i - 1]):
            pairs.append((i, j))
    return pairs


def _error(
    results: list[TrackResult], T_true: NDArray[np.float64], i: int, j: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the error (6,) of the motion from i to j, and Ad (6, 6) of its inverse."""
    moved = se3.inverse(results[i].T_world_cam) @ results[j].T_world_cam
    truly = se3.inverse(T_true[i]) @ T_true[j]
    return se3.log(se3.inverse(truly) @ moved), se3.adjoint(se3.inverse(moved))


def _line(name: str, scored: Score) -> str:
    translation, rotation = np.median(scored.blocks, axis=0)
    return (
        f'{name:44s} {np.median(scored.nees):6.1f} {scored.nees.mean():6.1f}'
        f' {translation:5.1f} {rotation:5.1f} {100 * scored.within:6.1f} {scored.worst:5.1f}'
    )


def _runs(arguments: argparse.Namespace) -> Iterator[tuple[str, str]]:
    for address in SYNTHETIC:
        for seed in range(arguments.seeds):
            yield f'{address}frames={arguments.frames}&seed={seed}', f'{address}seed={seed}'
    if arguments.data:
        for name in REAL:
            if (Path(arguments.data) / name).is_dir():
                yield str(Path(arguments.data) / name), name


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=5)
    parser.add_argument('--frames', type=int, default=300)
    parser.add_argument('--ablation', default='full')
    parser.add_argument('--data', type=Path, default=os.environ.get('DCGS_TEST_DATA'))
    arguments = parser.parse_args()
    print(f'{"":44s} median   mean   t     r   2 sigma %  worst / 3 sigma')
    for address, name in _runs(arguments):
        source = open_source(address)
        config = override(Config(sensor=source.sensor), {'ablation': arguments.ablation})
        tracker = Tracker(source.camera, config)
        results = [tracker.track(frame) for frame in source if isinstance(frame, RgbdFrame)]
        if source.groundtruth is None:
            raise SystemExit(f'{source.name} has no ground truth')
        if address.startswith('synthetic'):
            print(_line(name, score(results, source.groundtruth, 0, np.zeros((6, 6)))), flush=True)
            continue
        print(_line(f'{name} raw', score(results, source.groundtruth, 0, np.zeros((6, 6)))))
        offset_ns = clock_offset_ns(results, source.groundtruth)
        scored = score(results, source.groundtruth, offset_ns, _TRUTH)
        print(_line(f'{name} truth {offset_ns / 1e6:+.0f} ms', scored), flush=True)


if __name__ == '__main__':
    main()
