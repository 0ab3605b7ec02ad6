# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tracker, mapper and replay as processes over DDS, and what happens to them on a robot."""

from __future__ import annotations

import signal
from itertools import islice

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from camera import (  # type: ignore[import-not-found]
    COMPRESSED_TOPICS,
    Camera,
    compressed,
    every_shot,
)
from robot import Robot  # type: ignore[import-not-found]

from dcgs_ros.evaluation.trajectory import absolute_trajectory_error
from dcgs_ros.io.map_archive import read_map
from dcgs_ros.nodes.harness.observer import Observer
from dcgs_ros.nodes.messages.ids import split_ids

pytestmark = pytest.mark.slow

OFFLINE_CM = 0.64  # benchmarks/README.md
SYNTHETIC_CM = 1.0  # where there is no real sequence
SLACK = 1.15  # of the ATE against the run without ROS
JUMP_M = 0.15  # nobody moves a camera as far between two frames
COMPRESSED_FRAMES = 60
PLACE_M = 0.03  # how near the resumed tracker's poses are to the truth, once aligned


def ate_cm(robot: Robot) -> float:
    truth = robot.source.groundtruth
    assert truth is not None
    return absolute_trajectory_error(robot.observer.trajectory(), truth).rmse_cm


def largest_step_m(robot: Robot) -> float:
    T = robot.observer.trajectory().T_world_cam
    return float(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).max())


def connected(robot: Robot) -> Camera:
    """Return a camera that the tracker listens to."""
    camera = Camera(robot.observer)
    camera.connect(robot.source.camera)
    return camera


def test_every_pair_is_tracked_and_the_map_arrives_whole(robot: Robot) -> None:
    tracker, mapper = robot.tracker(), robot.mapper(mapping__final_steps=30)
    robot.wait_ready('tracker', 'mapper')
    camera = connected(robot)
    camera.play(every_shot(robot.source))
    camera.settle()
    assert len(robot.observer.poses) == len(robot.source)
    assert ate_cm(robot) < (SLACK * OFFLINE_CM if robot.is_real else SYNTHETIC_CM)

    # A third process that has come late has the mapper's map, once the mapper rests.
    late = Observer(robot.processes.domain, with_map=True)
    try:
        robot.wait(lambda: nothing_missing(robot.observer), 'all')
        robot.wait(lambda: at_rest(robot.observer), 'the mapper rests')
        folder = robot.saved()
        saved = read_map(folder / 'map.dcgs')
        robot.wait(lambda: same_ids(late, saved.ids), 'the late one has the map')
        rows = late.mirror.rows
        assert rows is not None and len(rows) > 10_000
        order = np.argsort(saved.ids)
        for k, axis in enumerate('xyz'):
            np.testing.assert_array_equal(rows[axis], saved.splats.means[k, order])
        for k in range(3):
            scales = np.exp(saved.splats.log_scales[k, order])
            np.testing.assert_array_equal(rows[f'scale_{k}'], scales)
        np.testing.assert_array_equal(rows['keyframe'], saved.hosts[order])
        robot.wait(lambda: same_map(robot.observer, late), 'so has who was there first')
    finally:
        late.close()
    assert robot.processes.stop(tracker, signal.SIGINT) == 0
    assert robot.processes.stop(mapper, signal.SIGTERM) == 0


def test_compressed_images_are_tracked_like_raw_ones(robot: Robot) -> None:
    robot.tracker(
        node__resume=False, node__color_transport='compressed',
        node__depth_transport='compressedDepth',
    )  # fmt: skip
    robot.wait_ready('tracker')
    camera = Camera(robot.observer, COMPRESSED_TOPICS)
    camera.connect(robot.source.camera)
    camera.play(map(compressed, islice(every_shot(robot.source), COMPRESSED_FRAMES)))
    camera.settle()
    assert len(robot.observer.poses) == COMPRESSED_FRAMES


def at_rest(observer: Observer) -> bool:
    return observer.status['dcgs_mapper'][2].get('steps_per_s') == '0'


def nothing_missing(observer: Observer) -> bool:
    return observer.value('dcgs_tracker', 'keyframes_missing') == 0


def same_ids(observer: Observer, ids: NDArray[np.int64]) -> bool:
    rows = observer.mirror.rows
    if rows is None:
        return False
    there = rows['id'].astype(np.int64)
    return np.array_equal(np.where(there < 0, there, split_ids(there)[1]), np.sort(ids))


def same_map(one: Observer, other: Observer) -> bool:
    """To the last bit."""
    rows, others = one.mirror.rows, other.mirror.rows
    return rows is not None and others is not None and rows.tobytes() == others.tobytes()


def test_a_mapper_that_dies_is_given_everything_again_and_tracking_misses_nothing(
    robot: Robot,
) -> None:
    robot.tracker()
    first = robot.mapper()
    robot.wait_ready('tracker', 'mapper')
    camera, film = connected(robot), every_shot(robot.source)
    camera.play(islice(film, 60))
    first.kill()
    first.wait()
    robot.observer.status.pop('dcgs_mapper')
    robot.mapper()
    camera.play(film)
    camera.settle()
    assert len(robot.observer.poses) == len(robot.source)
    robot.wait_ready('mapper')
    robot.wait(
        lambda: len(robot.observer.keyframes) > 0 and nothing_missing(robot.observer),
        'everything given again',
    )
    saved = read_map(robot.saved() / 'map.dcgs')
    measured = saved.ids[saved.ids >= 0]
    tracked = robot.observer.value('dcgs_tracker', 'gaussians')
    assert len(measured) > 0.9 * tracked  # some are pruned, on one side sooner
    assert measured.max() > 0.9 * tracked and measured.min() < 100  # from first to last


def test_a_tracker_that_dies_goes_on_in_the_same_map(robot: Robot) -> None:
    first = robot.tracker()
    robot.mapper()
    robot.wait_ready('tracker', 'mapper')
    camera = connected(robot)
    camera.play(islice(every_shot(robot.source), 120))
    robot.wait(lambda: robot.observer.mirror.rows is not None, 'a map')
    rows = robot.observer.mirror.rows
    assert rows is not None
    epochs = split_ids(rows['id'].astype(np.int64))[0]
    before = dict(robot.observer.poses)
    first.kill()
    first.wait()
    robot.observer.poses.clear()
    robot.observer.status.pop('dcgs_tracker')
    robot.tracker(node__resume_wait_s=60.0)
    robot.wait_ready('tracker')
    camera.connect(robot.source.camera)
    camera.play(islice(every_shot(robot.source), 120))
    camera.settle()
    common = sorted(before.keys() & robot.observer.poses.keys())
    assert len(common) > 30  # the same frames once more
    off = [before[k][:3, 3] - robot.observer.poses[k][:3, 3] for k in common]
    assert np.median(np.linalg.norm(off, axis=1)) < PLACE_M
    rows = robot.observer.mirror.rows
    assert rows is not None
    assert set(split_ids(rows['id'].astype(np.int64))[0]) == set(epochs)


def test_resets_are_answered(robot: Robot) -> None:
    robot.tracker()
    robot.mapper()
    robot.wait_ready('tracker', 'mapper')
    replay = robot.replay(loop=True)
    robot.wait_frames(40)
    assert robot.observer.call('/dcgs_tracker/reset').success
    keyframes = robot.observer.value('dcgs_tracker', 'keyframes')
    robot.wait_frames(80)
    robot.wait(lambda: robot.observer.value('dcgs_tracker', 'keyframes') != keyframes, 'a new map')
    assert robot.observer.call('/dcgs_mapper/reset').success
    robot.wait(lambda: robot.observer.value('dcgs_mapper', 'keyframes') > 0, 'again')
    assert robot.processes.stop(replay) == 0


def test_without_a_map_saving_says_so(robot: Robot) -> None:
    robot.mapper()
    robot.wait_ready('mapper')
    response = robot.observer.call('/dcgs_mapper/save_map')
    assert not response.success and 'no map' in response.message
