# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Tracker and mapper on the two ends of a wire, as a process: `python two_machines.py FOLDER`.

Prints what came of it as JSON. Of its own, since Fast DDS keeps what it found of the network for
the whole process.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import wire  # type: ignore[import-not-found]
from robot import Robot, sequence  # type: ignore[import-not-found]

from dcgs_ros.nodes.harness.observer import Observer, wait_until
from dcgs_ros.nodes.harness.processes import Processes

PROFILE = Path(__file__).resolve().parents[2] / 'config' / 'fastdds_network.xml'
PLAYED_S = 300.0
CAUGHT_UP_S = 60.0


def play(logs: Path) -> dict[str, Any]:
    """Tracker, replay and observer on one machine, the mapper on the other."""
    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
    with wire.wired() as (here, there), Processes(logs, 'SUBNET') as processes:
        with wire.entered(here):
            observer = Observer(processes.domain, discovery='SUBNET')
        at_home = wire.inside(here, own_shm=False)
        prefixes = {'tracker': at_home, 'replay': at_home, 'mapper': wire.inside(there)}
        robot = Robot(processes, observer, logs, sequence(), prefixes)
        try:
            robot.tracker(node__resume=False)
            robot.mapper()
            robot.wait_ready('tracker', 'mapper')
            played = robot.replay().wait(PLAYED_S)
            wait_until(lambda: _caught_up(observer), CAUGHT_UP_S, 'every keyframe arrived')
            return {
                'replay_status': played,
                'pairs': len(robot.source),
                'tracked': len(observer.poses),
                'latencies_ms': observer.latencies_ms().tolist(),
                'keyframes': int(observer.value('dcgs_tracker', 'keyframes')),
                'of_mapper': len(observer.keyframes),
                'received_bytes': wire.received_bytes(there),
            }
        finally:
            observer.close()


def _caught_up(observer: Observer) -> bool:
    lacking = observer.value('dcgs_tracker', 'keyframes_missing')
    return observer.value('dcgs_tracker', 'keyframes') > 0 and lacking == 0


if __name__ == '__main__':
    print(json.dumps(play(Path(sys.argv[1]))))
