# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The back end works beside the tracker, which never waits for it."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Correction, Keyframe
from dcgs_ros.nodes.tracking.back_end_worker import BackEndWorker, KnownKeyframes, NoLoops

CAMERA = PinholeCamera(16, 16, 14.0, 14.0, 7.5, 7.5)
SOON_S = 20.0  # only a failure takes so long
FRAME = RgbdFrame(1, 1, np.zeros((16, 16, 3), np.uint8), np.ones((16, 16), np.float32))
NONE = np.empty((0, 3), np.float32)


def keyframe() -> Keyframe:
    return Keyframe(FRAME, np.eye(4), np.eye(4), np.empty(0, np.int64), NONE, NONE)


class Scripted:
    """Answers every second keyframe with a correction."""

    def __init__(self) -> None:
        self.places: Any = object()
        self.loops: list[object] = []
        self.added, self.nice = 0, -1
        self.restored: list[Any] = []
        self.with_images = 0
        self.go = threading.Event()
        self.go.set()
        self.broken = False

    def restore(self, *known: Any) -> None:
        assert self.go.wait(SOON_S)
        self.restored = [list(part) if isinstance(part, Iterable) else part for part in known]
        if self.broken:
            raise ValueError('graph of 3 keyframes')

    def add(self, keyframe: Keyframe) -> None:
        self.added += 1
        self.with_images += keyframe.has_image

    def work(self) -> Correction | None:
        assert self.go.wait(SOON_S)
        if self.broken:
            raise ValueError('graph of 3 keyframes')
        if sys.platform == 'linux':
            self.nice = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
        if self.added % 2:
            return None
        self.loops.append(object())
        n = self.added
        return Correction(
            n, np.arange(n), np.tile(np.eye(4), (n, 1, 1)), np.zeros((n, 6, 6)),
            np.zeros(n, np.int32),
        )  # fmt: skip


class Bench:
    def __init__(self) -> None:
        self.scripted = Scripted()  # the first that is made
        self.made: list[Scripted] = []
        self.corrections: list[tuple[int, int]] = []  # revision and epoch
        self.warnings: list[str] = []
        self.worker = BackEndWorker(self._make, self._take, self.warnings.append)

    def _make(self, camera: PinholeCamera, config: Config) -> Scripted:
        self.made.append(Scripted() if self.made else self.scripted)
        return self.made[-1]

    def _take(self, correction: Correction, epoch: int) -> None:
        self.corrections.append((correction.revision, epoch))

    def wait(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + SOON_S
        while not condition():
            assert time.monotonic() < end
            time.sleep(0.002)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.worker.close()


def test_corrections_come_with_the_epoch_of_their_map(bench: Bench) -> None:
    for epoch in (300, 301):
        places = bench.worker.begin(CAMERA, Config(), epoch, None)
        assert places is bench.made[-1].places
        for count in (1, 2):
            bench.worker.add(keyframe())
            bench.wait(lambda n=count: bench.made[-1].added == n)  # type: ignore[misc]
        bench.wait(lambda e=epoch: (2, e) in bench.corrections)  # type: ignore[misc]
    assert bench.corrections == [(2, 300), (2, 301)]
    assert bench.worker.figures()['loops'] == 1
    if sys.platform == 'linux':
        assert bench.made[-1].nice == 19


def test_whoever_adds_keyframes_does_not_wait_for_the_work(bench: Bench) -> None:
    bench.worker.begin(CAMERA, Config(), 300, None)
    back_end = bench.made[-1]
    back_end.go.clear()
    bench.worker.add(keyframe())
    bench.wait(lambda: back_end.added == 1)
    start_s = time.monotonic()
    for _ in range(50):
        bench.worker.add(keyframe())
    bench.worker.figures()
    assert time.monotonic() - start_s < 0.5 and back_end.added == 1
    back_end.go.set()
    bench.wait(lambda: back_end.added == 51)
    assert not bench.corrections  # what waits is taken in before anything is computed again


def test_of_many_that_wait_the_newest_go_without_their_images(bench: Bench) -> None:
    bench.worker.begin(CAMERA, Config(), 300, None)
    back_end = bench.made[-1]
    back_end.go.clear()
    bench.worker.add(keyframe())
    bench.wait(lambda: back_end.added == 1)
    for _ in range(57):
        bench.worker.add(keyframe())
    assert bench.worker.figures()['keyframes_passed_over'] == 7
    back_end.go.set()
    bench.wait(lambda: back_end.added == 58)
    assert back_end.with_images == 51
    bench.wait(lambda: bool(bench.warnings))
    assert '7 keyframes were passed over while 50 waited' in bench.warnings[0]
    bench.worker.add(keyframe())
    bench.wait(lambda: back_end.added == 59)
    assert back_end.with_images == 52 and len(bench.warnings) == 1


def test_a_back_end_that_fails_is_left_and_the_next_map_has_another(bench: Bench) -> None:
    bench.worker.begin(CAMERA, Config(), 300, None)
    bench.made[-1].broken = True
    bench.worker.add(keyframe())
    bench.wait(lambda: bool(bench.warnings))
    assert 'graph of 3 keyframes' in bench.warnings[0]
    bench.worker.add(keyframe())
    bench.worker.begin(CAMERA, Config(), 301, None)
    for _ in range(2):
        bench.worker.add(keyframe())
    bench.wait(lambda: bench.made[-1].added == 2)
    bench.wait(lambda: bench.corrections == [(2, 301)])
    assert bench.made[0].added == 1 and len(bench.warnings) == 1


def knowing(name: str) -> Any:
    return SimpleNamespace(recognise=lambda _: [name], knows=lambda k: name == 'all')


@pytest.mark.parametrize('broken', [False, True])
def test_a_known_map_is_taken_in_by_the_thread_and_its_places_are_known_meanwhile(
    bench: Bench, broken: bool
) -> None:
    bench.scripted.go.clear()
    bench.scripted.broken, bench.scripted.places = broken, knowing('all')
    poses = np.tile(np.eye(4), (2, 1, 1))
    known = KnownKeyframes([4, 5], poses, [0, 1], iter([keyframe()]), CAMERA, knowing('file'))
    places: Any = bench.worker.begin(CAMERA, Config(), 300, known)
    bench.worker.add(keyframe())
    assert places.recognise(FRAME) == ['file'] and not places.knows(0)
    bench.made[-1].go.set()
    bench.wait(lambda: bool(bench.warnings if broken else bench.made[-1].added))
    stamps, _, submaps, keyframes, *_ = bench.made[-1].restored
    assert (stamps, submaps, len(keyframes)) == ([4, 5], [0, 1], 1)
    assert places.recognise(FRAME) == (['file'] if broken else ['all'])
    assert places.knows(0) is not broken


def test_in_a_map_that_is_not_to_change_nothing_is_done(bench: Bench) -> None:
    bench.worker.begin(CAMERA, Config(), 300, None)
    bench.worker.leave()
    bench.worker.add(keyframe())
    bench.worker.begin(CAMERA, Config(), 301, None)
    bench.worker.add(keyframe())
    bench.wait(lambda: bench.made[1].added == 1)
    assert bench.made[0].added == 0


def test_without_loops_there_is_nothing() -> None:
    loops = NoLoops()
    loops.begin(CAMERA, Config(), 300, None)
    loops.leave()
    loops.add(keyframe())
    loops.close()
    assert loops.figures() == {}
