# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A run that is killed leaves the trajectory and the map of a moment ago."""

from __future__ import annotations

import errno
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from dcgs_ros.cli.run import checkpoints
from dcgs_ros.cli.run.checkpoints import Checkpoints
from dcgs_ros.cli.run.pipeline import NoMapping, Pipeline
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.loop_closing import NoClosing
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.core.mapping.rectification import Images
from dcgs_ros.core.mapping.splats import Splats
from dcgs_ros.core.mapping.views import KeyframeView
from dcgs_ros.core.render.cpu import CpuRenderer
from dcgs_ros.core.tracking.result import TrackingState, TrackResult
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.evaluation.report import RunRecord, TrackedFrame
from dcgs_ros.io.ply import read_ply
from dcgs_ros.io.trajectory import read_tum

ROOT = Path(__file__).resolve().parents[3]
PATIENCE_S = 600.0
PROGRAM = """
import sys
from dcgs_ros.cli.main import main
from dcgs_ros.cli.run import checkpoints

checkpoints.INTERVAL_S = 0.5
main(['run', 'synthetic:room?frames=100000', '--out', sys.argv[1]])
"""


class AtOnce(NoMapping):
    """Calls the work in the thread that asks for it, as if the mapper were at rest."""

    def __init__(self, mapper: Mapper) -> None:
        self.mapper = mapper

    def between_steps(self, work: Callable[[Mapper], None]) -> None:
        work(self.mapper)


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoints, 'INTERVAL_S', 0.02)


@pytest.fixture
def mapper() -> Mapper:
    workers = Workers(1)
    mapper = Mapper(PinholeCamera(16, 16, 9, 9, 8, 8), Config(), CpuRenderer(workers), workers)
    images = Images(np.zeros((16, 16, 3), np.uint8), np.ones((16, 16), np.uint16))
    mapper.views.append(KeyframeView.of(0, 5, np.eye(4), images, None))
    planes = np.zeros((14, 3), np.float32)
    planes[2], planes[3:6], planes[6] = 1, -4, 1
    ids, reach_m = np.arange(3, dtype=np.int64), np.ones(3, np.float32)
    mapper.table.append(Splats(planes), ids, 0, np.ones((3, 3), np.float32), reach_m)
    return mapper


def pipeline_of(mapper: Mapper | None) -> Pipeline:
    mapping = NoMapping() if mapper is None else AtOnce(mapper)
    return Pipeline(cast(Tracker, None), mapping, NoClosing(), mapper, online=False)


def tracked(index: int, state: TrackingState = TrackingState.OK) -> TrackedFrame:
    result = TrackResult(
        index * 10**9, np.eye(4), np.eye(4), np.eye(6), np.eye(6), state, None, 9, 9, 9, False,
        (), 0.0,
    )  # fmt: skip
    return TrackedFrame(index, result, 0.01, 0)


def wait_for(condition: Callable[[], Any]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def poses(folder: Path) -> list[int]:
    """Return the seconds of the poses that are there, of a file that may grow meanwhile."""
    path = folder / 'trajectory.tum'
    if not path.exists() or path.read_text().count('\n') < 2:
        return []
    return [int(stamp_ns // 10**9) for stamp_ns in read_tum(path).stamps_ns]


def test_the_trajectory_grows_while_frames_are_tracked(tmp_path: Path) -> None:
    record = RunRecord('', '')

    def is_there(second: int) -> bool:
        return second in poses(tmp_path)

    with Checkpoints(tmp_path, record, pipeline_of(None)):
        for index in range(3):
            record.tracked += [tracked(2 * index), tracked(2 * index + 1, TrackingState.LOST)]
            wait_for(partial(is_there, 2 * index))
        assert poses(tmp_path) == [0, 2, 4]
    assert {path.name for path in tmp_path.iterdir()} == {'trajectory.tum'}


def test_a_run_without_a_pose_writes_nothing(tmp_path: Path) -> None:
    record = RunRecord('', '', tracked=[tracked(0, TrackingState.LOST)])
    with Checkpoints(tmp_path, record, pipeline_of(None)):
        time.sleep(0.1)
    assert list(tmp_path.iterdir()) == []


def test_the_map_is_saved_again_and_again(tmp_path: Path, mapper: Mapper) -> None:
    with Checkpoints(tmp_path, RunRecord('', ''), pipeline_of(mapper)):
        wait_for((tmp_path / 'map.ply').exists)
        saved = read_ply(tmp_path / 'map.ply')
        assert np.array_equal(saved.planes, mapper.table.splats.planes)
        mapper.table.planes[0, :2] = 1, np.nan
        wait_for(lambda: read_ply(tmp_path / 'map.ply').means[0].tolist() == [1, 0])


def test_a_short_runs_map_is_saved_while_it_is_refined(tmp_path: Path, mapper: Mapper) -> None:
    """Its frames were done, and the trajectory was written, before anything was due."""
    (tmp_path / 'trajectory.tum').write_text('whole')
    record = RunRecord('', '', tracked=[tracked(0)])
    with Checkpoints(tmp_path, record, pipeline_of(mapper)):
        wait_for((tmp_path / 'map.ply').exists)
    assert (tmp_path / 'trajectory.tum').read_text() == 'whole'


def test_a_map_without_gaussians_is_not_saved(tmp_path: Path, mapper: Mapper) -> None:
    mapper.table.keep(np.zeros(3, np.bool_))
    with Checkpoints(tmp_path, RunRecord('', ''), pipeline_of(mapper)):
        time.sleep(0.1)
    assert list(tmp_path.iterdir()) == []


def test_the_copy_is_of_when_the_mapper_was_at_rest(tmp_path: Path, mapper: Mapper) -> None:
    class Once(AtOnce):
        def between_steps(self, work: Callable[[Mapper], None]) -> None:
            if self.mapper.table.planes[0, 0] != 7:
                work(self.mapper)
            self.mapper.table.planes[:] = 7

    pipeline = Pipeline(cast(Tracker, None), Once(mapper), NoClosing(), mapper, online=False)
    before = mapper.table.splats.planes.copy()
    with Checkpoints(tmp_path, RunRecord('', ''), pipeline):
        wait_for((tmp_path / 'map.ply').exists)
    assert np.array_equal(read_ply(tmp_path / 'map.ply').planes, before)


def test_what_cannot_be_written_is_said_once_and_ends_nothing(
    tmp_path: Path,
    mapper: Mapper,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(path: Path, _: object) -> None:
        raise OSError(errno.ENOSPC, 'No space left on device', str(path))

    monkeypatch.setattr(checkpoints, 'write_ply', fail)
    with Checkpoints(tmp_path, RunRecord('', ''), pipeline_of(mapper)):
        time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith('dcgs: no more is saved before the end: [Errno 28] No space left')


def test_the_end_of_the_run_is_not_waited_for_where_the_mapper_is_busy(
    tmp_path: Path, mapper: Mapper
) -> None:
    asked = []

    class Busy(NoMapping):
        def between_steps(self, work: Callable[[Mapper], None]) -> None:
            asked.append(work)

    pipeline = Pipeline(cast(Tracker, None), Busy(), NoClosing(), mapper, online=False)
    with Checkpoints(tmp_path, RunRecord('', ''), pipeline):
        wait_for(lambda: asked)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_run_that_is_killed_keeps_trajectory_and_map(tmp_path: Path) -> None:
    folder = tmp_path / 'run'
    process = subprocess.Popen([sys.executable, '-c', PROGRAM, str(folder)], cwd=ROOT)
    try:
        wait_for(lambda: (folder / 'map.ply').exists() and len(poses(folder)) > 2)
    finally:
        process.kill()
        process.wait()
    assert len(read_tum(folder / 'trajectory.tum')) > 2
    assert len(read_ply(folder / 'map.ply')) > 1000
