# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A lost camera in a map: `python -m benchmarks.relocalization [--data FOLDER] [--maps NAME ...]`.

Of a real sequence the map is of the first half. The tracker then begins again and again somewhere
in the second half, not knowing where, and has a second of frames to say where it is. In a
synthetic scene the map is of the whole sequence, and the tries are from beside its path. Only
tries count at whose beginning most of the view was seen by the map. Wrong is a pose that is
claimed and is more than 10 cm or 5 degrees off, in the alignment of the map.

Look-alike are tries in other places that resemble the map's: the same scene with other textures,
the same furniture rearranged, another room of the same building. Foreign are tries with frames of
other sequences. Of both, any pose that is claimed is wrong.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.altered_scenes import Altered, rearranged, redecorated
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
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.evaluation.trajectory import align_umeyama, nearest

SYNTHETIC = [
    f'synthetic:{scene}?frames=300&seed={seed}' for scene in ('room', 'desk') for seed in range(2)
]
RING = 'synthetic:ring?frames=300&seed=3&speed=2'
ROUND_THE_RING = 'synthetic:ring?frames=2150&seed=3&speed=2'
REAL = ['tum_fr3_teddy_200', 'mini_fr1_xyz_vga_120', 'tum_fr1_rpy_240']
_SECOND = 30  # frames
_BRIEF = 6  # frames of a try in another place
_SEEN = 0.8  # share of the view at the beginning of a try that counts
_WRONG_M, _WRONG_RAD = 0.10, math.radians(5)
_FRAME_NS = 33_333_333
_TRIES, _LOOK_ALIKE, _FOREIGN = 50, 50, 130  # in each map
_UNSEEN = 0.02  # share of the view that may be seen from another room


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
        name = address if 'synthetic:' in address else Path(address).name
        return cls(name, source, views)


class Map:
    """A tracker in the map of a clip, which nothing changes any more."""

    def __init__(self, clip: Clip, views: Sequence[View]) -> None:
        """Track the views, with the back end."""
        self.clip, self.known = clip, views
        self.tracker = Tracker(clip.source.camera, Config(sensor=clip.source.sensor))
        closing = ClosingInLockstep(self.tracker, _NoMap())  # type: ignore[arg-type]
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

    def share_seen(self, view: View) -> float:
        """Return which share of a view the map has seen."""
        return share_seen(view, self.known[::5], self.clip.source.camera)

    def found_after(self, views: Iterable[View]) -> tuple[int, NDArray[np.float64]] | None:
        """Return after how many frames a pose was claimed, and its error (6,); None: never."""
        self.tracker.interrupt()
        for number, (frame, T) in enumerate(views, start=1):
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


def rendered(source: SyntheticSource, start: int, count: int) -> Iterator[View]:
    """Yield frames of a synthetic sequence with their true poses, each when it is asked for."""
    for k in range(start, min(start + count, len(source))):
        frame = source.render(k)
        yield frame, source.pose(frame.stamp_ns)


def seen(known: Map, tries: Iterable[Iterator[View]]) -> Tally:
    """Return what came of tries that begin where the map has seen most of the view."""
    tally = Tally()
    for views in tries:
        if tally.tries == _TRIES:
            break
        first = next(views)
        if known.share_seen(first) < _SEEN:
            continue
        tally.tries += 1
        found = known.found_after(itertools.chain([first], views))
        if found is None:
            continue
        number, error = found
        off = np.linalg.norm(error[:3]) > _WRONG_M or np.linalg.norm(error[3:]) > _WRONG_RAD
        tally.wrong += int(off)
        tally.found += int(not off)
        tally.frames += number
    return tally


def elsewhere(known: Map, tries: Iterable[Iterable[View]]) -> Tally:
    """Return what came of tries in other places, where each pose is wrong."""
    tally = Tally()
    for views in tries:
        tally.tries += 1
        tally.wrong += known.found_after(views) is not None
    return tally


def beside_the_path(address: str, rng: np.random.Generator) -> Iterator[Iterator[View]]:
    """Yield a second of frames from beside the path again and again."""
    while True:
        source = Altered(address, rng)
        yield rendered(source, int(rng.integers(len(source) - _SECOND)), _SECOND)


def second_half(clip: Clip, rng: np.random.Generator) -> Iterator[Iterator[View]]:
    """Yield a second of frames from each place in the second half, in random order."""
    rest = clip.views[len(clip.views) // 2 :]
    for start in rng.permutation(len(rest) - 5).tolist():
        yield iter(rest[start : start + _SECOND])


def look_alikes(address: str, rng: np.random.Generator) -> Iterator[Iterator[View]]:
    """Yield frames of the scene with other textures, and rearranged, in turn.

    Those with other textures are from where the map ends: the last pose is always tried.
    """
    for change in itertools.cycle((redecorated, rearranged)):
        source = Altered(address, rng, change)
        span = _SECOND if change is redecorated else len(source) - _BRIEF
        yield rendered(source, len(source) - _BRIEF - 1 - int(rng.integers(span)), _BRIEF)


def other_rooms(known: Map, rng: np.random.Generator) -> Iterator[Iterator[View]]:
    """Yield frames of the ring from where nothing of the map is seen."""
    source = SyntheticSource.from_address(ROUND_THE_RING)
    while True:
        start = int(rng.integers(len(source) - _BRIEF))
        if known.share_seen(next(rendered(source, start, 1))) <= _UNSEEN:
            yield rendered(source, start, _BRIEF)


def others(clip: Clip, clips: Sequence[Clip], rng: np.random.Generator) -> Iterator[list[View]]:
    """Yield frames of the sequences of other places whose images are of the same size."""
    size, place = clip.views[0][0].depth_m.shape, _place(clip)
    strange = [
        other for other in clips
        if _place(other) != place and other.views[0][0].depth_m.shape == size
    ]  # fmt: skip
    for other in itertools.cycle(strange):
        start = int(rng.integers(len(other.views) - 5))
        yield other.views[start : start + _BRIEF]


def _place(clip: Clip) -> str:
    """Return where a clip was taken: both of fr1 show one desk."""
    return 'fr1' if 'fr1' in clip.name else clip.name.split('?')[0]


def row(clip: Clip, clips: Sequence[Clip]) -> str:
    """Return the row of the table of the map of a clip."""
    rng, synthetic = np.random.default_rng, isinstance(clip.source, SyntheticSource)
    known = Map(clip, clip.views if synthetic else clip.views[: len(clip.views) // 2])
    own, alike = Tally(), Tally()
    if clip.name == RING:
        alike = elsewhere(known, itertools.islice(other_rooms(known, rng(1)), _LOOK_ALIKE))
    elif synthetic:
        own = seen(known, beside_the_path(clip.name, rng(0)))
        alike = elsewhere(known, itertools.islice(look_alikes(clip.name, rng(1)), _LOOK_ALIKE))
    else:
        own = seen(known, second_half(clip, rng(0)))
    theirs = elsewhere(known, itertools.islice(others(clip, clips, rng(2)), _FOREIGN))
    others_said = f'{alike.tries} | {alike.wrong} | {theirs.tries} | {theirs.wrong}'
    return f'| {clip.name} | {own} | {others_said} |'


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--data', type=Path, help='folder of the real sequences')
    parser.add_argument('--maps', nargs='+', default=[''], help='only those with this in the name')
    arguments = parser.parse_args()
    real = [str(arguments.data / name) for name in REAL] if arguments.data else []
    clips = [Clip.of(address) for address in [*SYNTHETIC, RING, *real]]
    print('| map of | tries | found in 1 s | after s | wrong | alike | wrong | foreign | wrong |')
    print('|---|---|---|---|---|---|---|---|---|')
    for clip in clips:
        if any(part in clip.name for part in arguments.maps):
            print(row(clip, clips), flush=True)


if __name__ == '__main__':
    main()
