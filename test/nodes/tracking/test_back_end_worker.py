# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The back end works beside the tracker, which never waits for it."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Correction, Keyframe
from dcgs_ros.nodes.tracking.back_end_worker import BackEndWorker, NoLoops

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
        self.go = threading.Event()
        self.go.set()
        self.broken = False

    def add(self, keyframe: Keyframe) -> None:
        self.added += 1

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
        self.made: list[Scripted] = []
        self.corrections: list[tuple[int, int]] = []  # revision and epoch
        self.warnings: list[str] = []
        self.worker = BackEndWorker(self._make, self._take, self.warnings.append)

    def _make(self, camera: PinholeCamera, config: Config) -> Scripted:
        self.made.append(Scripted())
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
        places = bench.worker.begin(CAMERA, Config(), epoch)
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
    bench.worker.begin(CAMERA, Config(), 300)
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


def test_a_back_end_that_fails_is_left_and_the_next_map_has_another(bench: Bench) -> None:
    bench.worker.begin(CAMERA, Config(), 300)
    bench.made[-1].broken = True
    bench.worker.add(keyframe())
    bench.wait(lambda: bool(bench.warnings))
    assert 'graph of 3 keyframes' in bench.warnings[0]
    bench.worker.add(keyframe())
    bench.worker.begin(CAMERA, Config(), 301)
    for _ in range(2):
        bench.worker.add(keyframe())
    bench.wait(lambda: bench.made[-1].added == 2)
    bench.wait(lambda: bench.corrections == [(2, 301)])
    assert bench.made[0].added == 1 and len(bench.warnings) == 1


def test_in_a_map_of_another_tracker_nothing_is_done(bench: Bench) -> None:
    bench.worker.begin(CAMERA, Config(), 300)
    bench.worker.leave()
    bench.worker.add(keyframe())
    bench.worker.begin(CAMERA, Config(), 301)
    bench.worker.add(keyframe())
    bench.wait(lambda: bench.made[1].added == 1)
    assert bench.made[0].added == 0


def test_without_loops_there_is_nothing() -> None:
    loops = NoLoops()
    loops.begin(CAMERA, Config(), 300)
    loops.leave()
    loops.add(keyframe())
    loops.close()
    assert loops.figures() == {}
