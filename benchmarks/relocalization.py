# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A lost camera in a map: `python -m benchmarks.relocalization [--data FOLDER] [--tries N]`.

The map is of the first half of a sequence. The tracker then begins again and again somewhere in
the second half, not knowing where, and has a second of frames to say where it is. Only tries count
at whose beginning most of the view was seen in the first half. Wrong is a pose that is claimed and
is more than 10 cm or 5 degrees off, in the alignment of the first half. Foreign are tries with
frames of other sequences: any pose that is claimed is wrong.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.covisibility import View, share_seen
from dcgs_ros.core import se3
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.errors import FrameError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.loop_closing import ClosingInLockstep
from dcgs_ros.core.tracking.result import TrackingState
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import Source
from dcgs_ros.evaluation.trajectory import align_umeyama, nearest

SYNTHETIC = [f'synthetic:room?frames=200&seed={seed}' for seed in range(2)]
LOOK_ALIKE = [f'synthetic:ring?frames=60&seed={seed}' for seed in range(3, 5)]
REAL = ['tum_fr3_teddy_200', 'mini_fr1_xyz_vga_120', 'tum_fr1_rpy_240']
_SECOND = 30  # frames
_SEEN = 0.8  # share of the view at the beginning of a try that counts
_WRONG_M, _WRONG_RAD = 0.10, math.radians(5)
_FRAME_NS = 33_333_333


class _NoMap:
    def correct(self, correction: object) -> None:
        """Ignore the correction."""


@dataclass
class Tally:
    """What came of the tries in one map."""

    tries: int = 0
    found: int = 0
    wrong: int = 0
    frames: int = 0  # until found, in all

    def __str__(self) -> str:
        """Return the columns of a row."""
        share = f'{100 * self.found / self.tries:.0f} %' if self.tries else '-'
        mean_s = f'{self.frames / max(self.found, 1) / 30:.2f}'
        return f'{self.tries} | {share} | {mean_s} | {self.wrong}'


@dataclass(frozen=True)
class Clip:
    """Frames with their true poses."""

    name: str
    source: Source
    views: list[View]

    @classmethod
    def of(cls, address: str) -> Clip:
        """Read a sequence; frames without truth are left out."""
        source = open_source(address)
        truth, frames = source.groundtruth, [f for f in source if isinstance(f, RgbdFrame)]
        assert truth is not None
        at, gap = nearest(np.array([f.stamp_ns for f in frames]), truth.stamps_ns)
        views = [
            (frame, truth.T_world_cam[k])
            for frame, k, ns in zip(frames, at, gap, strict=True)
            if ns < 20_000_000
        ]
        return cls(Path(address).name, source, views)


class Map:
    """A tracker in the map of a clip's first half, which nothing changes any more."""

    def __init__(self, clip: Clip) -> None:
        """Track the first half, with the back end."""
        self.tracker = Tracker(clip.source.camera, Config(sensor=clip.source.sensor))
        closing = ClosingInLockstep(self.tracker, _NoMap())  # type: ignore[arg-type]
        self.known = clip.views[: len(clip.views) // 2]
        poses = []
        for frame, _ in self.known:
            result = self.tracker.track(frame)
            closing.after(result)
            closing.advance()
            poses.append(result.T_world_cam)
        true = np.array([T for _, T in self.known])
        self.T_truth_world = align_umeyama(_tripods(np.array(poses)), _tripods(true))
        self.tracker.localize_only = True
        self._stamp_ns = self.known[-1][0].stamp_ns

    def found_after(self, views: Sequence[View]) -> tuple[int, NDArray[np.float64]] | None:
        """Return after how many frames a pose was claimed, and its error (6,); None: never."""
        self.tracker.interrupt()
        for number, (frame, T) in enumerate(views[:_SECOND], start=1):
            self._stamp_ns += _FRAME_NS
            late_ns = frame.depth_stamp_ns - frame.stamp_ns
            stamped = replace(
                frame, stamp_ns=self._stamp_ns, depth_stamp_ns=self._stamp_ns + late_ns
            )
            try:
                result = self.tracker.track(stamped)
            except FrameError:
                continue
            if result.state is not TrackingState.LOST:
                return number, se3.log(se3.inverse(T) @ self.T_truth_world @ result.T_world_cam)
        return None


def _tripods(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return four points (4 N, 3) at each pose (N, 4, 4): positions alone may be in one place."""
    local = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    points = np.einsum('nij,kj->nki', poses[:, :3, :3], local) + poses[:, None, :3, 3]
    return np.asarray(points.reshape(-1, 3))


def halves(clip: Clip, tries: int, rng: np.random.Generator) -> Tally:
    """Return what came of tries in the second half."""
    known, tally = Map(clip), Tally()
    rest = clip.views[len(clip.views) // 2 :]
    sparse = known.known[::5]
    starts = rng.permutation(len(rest) - 5)
    for start in starts[:tries].tolist():
        if share_seen(rest[start], sparse, clip.source.camera) < _SEEN:
            continue
        tally.tries += 1
        found = known.found_after(rest[start:])
        if found is None:
            continue
        number, error = found
        off = np.linalg.norm(error[:3]) > _WRONG_M or np.linalg.norm(error[3:]) > _WRONG_RAD
        tally.wrong += int(off)
        tally.found += int(not off)
        tally.frames += number
    return tally


def foreign(clip: Clip, others: Sequence[Clip], tries: int, rng: np.random.Generator) -> Tally:
    """Return what came of tries with frames of other sequences of the same camera's size."""
    known, tally = Map(clip), Tally()
    size = clip.views[0][0].depth_m.shape
    for other in others:
        if other.views[0][0].depth_m.shape != size:
            continue
        for start in rng.permutation(len(other.views) - 5)[:tries].tolist():
            tally.tries += 1
            tally.wrong += known.found_after(other.views[start : start + 10]) is not None
    return tally


def _place(clip: Clip) -> str:
    """Return where a clip was taken: both of fr1 show one desk."""
    return 'fr1' if 'fr1' in clip.name else clip.name.split('?')[0]


def rows(addresses: Sequence[str], tries: int) -> Iterator[str]:
    """Yield a row of the table for each sequence."""
    clips = [Clip.of(address) for address in addresses]
    strange = [*clips, *(Clip.of(address) for address in LOOK_ALIKE)]
    for clip in clips:
        rng = np.random.default_rng(0)
        own = halves(clip, tries, rng)
        others = [other for other in strange if _place(other) != _place(clip)]
        theirs = foreign(clip, others, max(tries // 4, 1), rng)
        yield f'| {clip.name} | {own} | {theirs.tries} | {theirs.wrong} |'


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--data', type=Path, help='folder of the real sequences')
    parser.add_argument('--tries', type=int, default=60, help='in the second half of each')
    arguments = parser.parse_args()
    real = [str(arguments.data / name) for name in REAL] if arguments.data else []
    print(
        '| map of the first half of | tries | found in 1 s | after s | wrong | foreign | wrong |'
    )
    print('|---|---|---|---|---|---|---|')
    for row in rows([*SYNTHETIC, *real], arguments.tries):
        print(row, flush=True)


if __name__ == '__main__':
    main()
