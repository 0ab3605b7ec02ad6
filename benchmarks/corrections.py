# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Time of corrections: `python -m benchmarks.corrections [--keyframes N]`.

Odometry of laps of 55 m with a keyframe every 30 cm and an honest covariance, a right loop for
every third keyframe after the first lap, and wild ones, each wrong in its own way, between. What
the back end does with a keyframe is timed without images: consistency, pose graph, covariances. A
row for each number of wild loops, and one for a pose graph that is given them all at once.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Collection, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.backend.back_end import BackEnd
from dcgs_ros.core.backend.closure import Loop
from dcgs_ros.core.backend.edges import Edge, information_of, odometry_edges
from dcgs_ros.core.backend.features import Features
from dcgs_ros.core.backend.keyframe_graph import warm_up
from dcgs_ros.core.backend.places import Places
from dcgs_ros.core.backend.pose_graph import optimise
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Keyframe, Odometry

COLUMNS = (
    'keyframes', 'wild loops', 'right ones kept', 'wild ones kept', 'corrections',
    'ms a keyframe: median', 'p99', 'at most', 's in all', 'pose graph of all at once, s',
)  # fmt: skip
WILD = (0, 20, 100)
_STEP_M, _LAP = 0.3, 183
_HOSTS = 3
_DRIFT = np.repeat([0.004, 0.003], 3)  # m and rad, a step
_LOOP = np.diag(np.square(np.repeat([0.01, 0.006], 3)))
_EVERY, _INLIERS = 3, 100
_WILD = 0.3  # m and rad
_CAMERA = PinholeCamera(640, 480, 600.0, 600.0, 319.5, 239.5)


class Given:
    """A `LoopFinder` that is told the loops."""

    def __init__(self, loops: Sequence[Loop]) -> None:
        """Take the loops of all keyframes."""
        self.places = Places(_CAMERA, Config())
        self._loops = loops

    def add(
        self,
        keyframe: Keyframe,
        camera: PinholeCamera | None = None,
        features: Features | None = None,
    ) -> None:
        """Keep nothing."""

    def close(self, keyframe: int) -> list[Loop]:
        """Return those that end at a keyframe."""
        return [loop for loop in self._loops if loop.b == keyframe]


def circle(count: int) -> NDArray[np.float64]:
    """Return poses (count, 4, 4) along a circle, z ahead."""
    angle, radius_m = 2.0 * np.pi / _LAP, _LAP * _STEP_M / (2.0 * np.pi)
    turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, angle, 0.0]))
    step = np.eye(4)
    step[2, 3] = radius_m * angle
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(se3.orthonormalised(poses[-1] @ step @ turn))
    return np.array(poses)


def tracked(truth: NDArray[np.float64], rng: np.random.Generator) -> list[Keyframe]:
    """Return keyframes that show nothing and drift from the truth (K, 4, 4)."""
    poses = [truth[0]]
    image = RgbdFrame(0, 0, np.zeros((2, 2, 3), np.uint8), np.ones((2, 2), np.float32))
    none, found = np.empty((0, 3), np.float32), []
    for k in range(len(truth)):
        if k:
            error = se3.exp(_DRIFT * rng.normal(size=6))
            poses.append(poses[-1] @ se3.inverse(truth[k - 1]) @ truth[k] @ error)
        hosts = np.arange(max(k - _HOSTS, 0), k, dtype=np.int32)
        T_host_cam = np.array([se3.inverse(poses[h]) @ poses[k] for h in hosts])
        information = np.tile(np.diag(_DRIFT**-2.0) / max(len(hosts), 1), (len(hosts), 1, 1))
        odometry = Odometry(
            k, 0, hosts, T_host_cam.reshape(-1, 4, 4), information, np.diag(np.square(_DRIFT))
        )
        ids = np.empty(0, np.int64)
        found.append(Keyframe(image, poses[k], np.eye(4), ids, none, none, odometry))
    return found


def loops_of(
    truth: NDArray[np.float64], wild: int, rng: np.random.Generator
) -> tuple[list[Loop], list[Loop]]:
    """Return right and wild loops."""
    right = []
    for b in range(_LAP, len(truth), _EVERY):
        error = se3.exp(np.sqrt(np.diag(_LOOP)) * rng.normal(size=6))
        T = se3.inverse(truth[b - _LAP]) @ truth[b] @ error
        right.append(Loop(b - _LAP, b, T, _LOOP, _INLIERS))
    ends = np.sort([rng.choice(len(truth), 2, replace=False) for _ in range(wild)], axis=-1)
    moved = [se3.exp(_WILD * rng.normal(size=6)) for _ in range(wild)]
    pairs = zip(ends.tolist(), moved, strict=True)
    return right, [Loop(a, b, T, _LOOP, _INLIERS) for (a, b), T in pairs]


def _kept(loops: Sequence[Loop], ends: Collection[tuple[int, int]]) -> str:
    return f'{sum((loop.a, loop.b) in ends for loop in loops)} of {len(loops)}'


def graph_s(keyframes: Sequence[Keyframe], loops: Sequence[Loop]) -> float:
    """Return the seconds that a pose graph of all keyframes and loops takes."""
    edges = [edge for one in keyframes if one.odometry for edge in odometry_edges(one.odometry)]
    edges += [
        Edge(loop.a, loop.b, loop.T_a_b, information_of(loop.covariance), loop=True)
        for loop in loops
    ]
    poses = np.array([keyframe.T_world_cam for keyframe in keyframes])
    begin = time.perf_counter()
    optimise(poses, edges, [0])
    return time.perf_counter() - begin


def rows(count: int) -> Iterator[list[str]]:
    """Yield the cells of a row for each number of wild loops."""
    for wild in WILD:
        rng = np.random.default_rng(wild)
        truth = circle(count)
        keyframes, (right, wrong) = tracked(truth, rng), loops_of(truth, wild, rng)
        back_end = BackEnd(_CAMERA, Config(), Given([*right, *wrong]))
        seconds, corrections = [], 0
        for keyframe in keyframes:
            begin = time.perf_counter()
            back_end.add(keyframe)
            corrections += back_end.work() is not None
            seconds.append(time.perf_counter() - begin)
        ms = 1e3 * np.percentile(seconds, [50, 99, 100])
        kept = {(loop.a, loop.b) for loop in back_end.loops}
        yield [
            str(count), str(wild), _kept(right, kept), _kept(wrong, kept), str(corrections),
            *(f'{value:.0f}' for value in ms), f'{sum(seconds):.0f}',
            f'{graph_s(keyframes, [*right, *wrong]):.1f}',
        ]  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--keyframes', type=int, default=1000)
    arguments = parser.parse_args()
    warm_up()
    print(f'| {" | ".join(COLUMNS)} |\n|{"---|" * len(COLUMNS)}', flush=True)
    for cells in rows(arguments.keyframes):
        print(f'| {" | ".join(cells)} |', flush=True)


if __name__ == '__main__':
    main()
