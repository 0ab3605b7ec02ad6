# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tracker and mapper as processes that are started in a saved map, over DDS."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')

from camera import Camera, every_shot  # type: ignore[import-not-found]
from robot import Robot  # type: ignore[import-not-found]

from dcgs_ros.io.map_archive import read_map

pytestmark = pytest.mark.slow

FRAMES = 60
FOUND_S = 3.0  # from the first image to the first pose
CONNECTED_NS = 1  # stamp of the camera_info that comes before the first image
PLACE_M = 0.03


def played(robot: Robot, start: int, end: int) -> None:
    camera = Camera(robot.observer)
    camera.connect(robot.source.camera)
    camera.play(islice(every_shot(robot.source), start, end))
    camera.settle()


def found_after_s(robot: Robot) -> float:
    """Return the time from the first image to the first pose, of the clock on the wall."""
    sent_s = (second for stamp, second in robot.observer.sent_s.items() if stamp > CONNECTED_NS)
    return float(min(robot.observer.came_s.values()) - min(sent_s))


def restarted(robot: Robot) -> None:
    """Forget what the nodes before have said."""
    for node in robot.started:
        node.kill()
        node.wait()
    robot.started.clear()
    observer = robot.observer
    for record in (observer.status, observer.poses, observer.came_s, observer.sent_s):
        record.clear()


def test_both_nodes_go_on_in_a_saved_map_and_localising_leaves_it(robot: Robot) -> None:
    robot.tracker(), robot.mapper(mapping__final_steps=30)
    robot.wait_ready('tracker', 'mapper')
    played(robot, 0, FRAMES)
    before = dict(robot.observer.poses)
    missing = 'keyframes_missing'
    robot.wait(lambda: robot.observer.value('dcgs_tracker', missing) == 0, 'all there')
    path = robot.saved() / 'map.dcgs'
    first, data = read_map(path), path.read_bytes()

    # A second day: both nodes from the file, as after a restart of the robot.
    restarted(robot)
    robot.mapper(mapping__final_steps=30, node__map=path)
    robot.tracker(node__map=path)
    robot.wait_ready('tracker', 'mapper')
    played(robot, FRAMES // 2, 2 * FRAMES)
    assert found_after_s(robot) < FOUND_S
    assert nearly_the_same(robot, before)
    before |= robot.observer.poses
    robot.wait(lambda: robot.observer.value('dcgs_tracker', missing) == 0, 'all there')
    both = read_map(robot.saved() / 'map.dcgs')
    assert len(both.sessions) == 2 and both.sessions[1].keyframes > 0
    fresh = np.setdiff1d(both.tracker.ids, first.tracker.ids)
    assert len(fresh) and fresh.min() >= first.tracker.next_id
    assert np.isin(first.ids[first.ids >= 0], both.ids).mean() > 0.9  # some are pruned

    # A third one only localises, without a mapper, in a map that the tracker has saved.
    response = robot.observer.call('/dcgs_tracker/save_map')
    assert response.success, response.message
    alone = Path(response.message.rpartition(' in ')[2]) / 'map.dcgs'
    known = read_map(alone)
    restarted(robot)
    robot.tracker(node__map=alone, node__mode='localization')
    robot.wait_ready('tracker')
    played(robot, FRAMES, 2 * FRAMES)
    assert found_after_s(robot) < FOUND_S
    assert nearly_the_same(robot, before)
    response = robot.observer.call('/dcgs_tracker/save_map')
    again = read_map(Path(response.message.rpartition(' in ')[2]) / 'map.dcgs')
    assert again.tracker.is_same_map(known.tracker)
    response = robot.observer.call('/dcgs_tracker/load_map')
    assert response.success and 'the camera is looked for' in response.message
    assert path.read_bytes() == data


def nearly_the_same(robot: Robot, before: dict[int, np.ndarray]) -> bool:
    """Return whether poses of the frames that were seen before are where they were."""
    common = sorted(before.keys() & robot.observer.poses.keys())
    off = [before[k][:3, 3] - robot.observer.poses[k][:3, 3] for k in common]
    return len(common) > FRAMES // 4 and bool(np.median(np.linalg.norm(off, axis=1)) < PLACE_M)


def test_a_map_that_is_none_ends_a_node_in_words(robot: Robot, tmp_path: Path) -> None:
    (tmp_path / 'a.dcgs').write_bytes(b'no map')
    for start in (robot.tracker, robot.mapper):
        for parameters in ({'node__map': tmp_path / 'a.dcgs'}, {'node__mode': 'localization'}):
            assert start(**parameters).wait(60) == 2


def test_autosaving_writes_a_map_while_mapping(robot: Robot) -> None:
    robot.tracker(), robot.mapper(node__autosave_s=1.0)
    robot.wait_ready('tracker', 'mapper')
    played(robot, 0, FRAMES // 2)
    path = robot.logs / 'maps' / 'autosave.dcgs'
    robot.wait(path.exists, 'a map')
    assert len(read_map(path).ids) > 0
