# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tracker and mapper on the two ends of a wire: `two_machines.py FOLDER [RATE [SOURCE]]`.

The sequence is played as fast as the tracker takes it, or at a rate. Prints what came of it as
JSON. A process of its own, since Fast DDS keeps what it found of the network all its life.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import wire  # type: ignore[import-not-found]
from camera import Camera, every_shot  # type: ignore[import-not-found]
from robot import Robot, sequence  # type: ignore[import-not-found]
from sensor_msgs.msg import PointCloud2

from dcgs_ros.evaluation.trajectory import absolute_trajectory_error
from dcgs_ros.io.ros_images import stamp_ns
from dcgs_ros.nodes.harness.observer import Observer
from dcgs_ros.nodes.harness.processes import Processes
from dcgs_ros.nodes.messages.maps import read_stamps
from dcgs_ros.nodes.transport import RELIABLE

PROFILE = Path(__file__).resolve().parents[2] / 'config' / 'fastdds_network.xml'
HANGS_S = 300.0  # only a failure takes so long


def play(logs: Path, rate: float | None, source: str) -> dict[str, Any]:
    """Tracker, replay and observer on one machine, the mapper on the other."""
    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
    with wire.wired() as (here, there), Processes(logs, 'SUBNET') as processes:
        with wire.entered(here):
            observer = Observer(processes.domain, discovery='SUBNET')
        at_home = wire.inside(here, own_shm=False)
        prefixes = {'tracker': at_home, 'replay': at_home, 'mapper': wire.inside(there)}
        robot = Robot(processes, observer, logs, source, prefixes)
        offered = _listen(observer)
        try:
            robot.tracker(node__resume=False)
            robot.mapper()
            robot.wait_ready('tracker', 'mapper')
            if rate is None:
                _play_in_step(robot)
            else:
                robot.replay(rate=rate).wait(HANGS_S)
            robot.wait(lambda: _arrived(observer, offered), 'every keyframe')
            return {
                'pairs': len(robot.source),
                'tracked': len(observer.poses),
                'ate_cm': _ate_cm(robot),
                'latencies_ms': observer.latencies_ms().tolist(),
                'keyframes': len(offered),
                'of_mapper': len(observer.keyframes),
                'received_bytes': wire.received_bytes(there),
            }
        finally:
            observer.close()


def _play_in_step(robot: Robot) -> None:
    camera = Camera(robot.observer)
    camera.connect(robot.source.camera)
    camera.play(every_shot(robot.source))
    camera.settle()


def _ate_cm(robot: Robot) -> float | None:
    truth = robot.source.groundtruth
    if truth is None:
        return None
    return absolute_trajectory_error(robot.observer.trajectory(), truth).rmse_cm


def _listen(observer: Observer) -> set[int]:
    """Fill a set with the stamps of the keyframes that the tracker offers."""
    offered: set[int] = set()

    def hear(gaussians: PointCloud2) -> None:
        if gaussians.width:  # else it is a view
            offered.add(stamp_ns(gaussians.header.stamp))

    observer.node.create_subscription(PointCloud2, 'keyframe/gaussians', hear, RELIABLE)
    return offered


def _arrived(observer: Observer, offered: set[int]) -> bool:
    """Tell whether the mapper has every keyframe that the tracker has made."""
    made = observer.value('dcgs_tracker', 'keyframes')
    return len(offered) >= made > 0 and offered <= set(read_stamps(observer.keyframes))


if __name__ == '__main__':
    folder, *rest = sys.argv[1:]
    chosen = float(rest[0]) if rest else None
    print(json.dumps(play(Path(folder), chosen, rest[1] if rest[1:] else sequence())))
