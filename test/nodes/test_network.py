# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The mapper on another machine, behind 100 Mbit/s, 20 ms and a lost packet in a hundred."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy')

import wire  # type: ignore[import-not-found]
from robot import Robot, sequence  # type: ignore[import-not-found]

from dcgs_ros.nodes.session import Observer, Processes, wait_until

LACKING = wire.why_not()
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(LACKING is not None, reason=f'no namespaces and wire: {LACKING}'),
    # Fast DDS keeps what it found of the network for the whole process: not after other tests.
    pytest.mark.skipif(
        not os.environ.get('DCGS_TEST_NETWORK'), reason='DCGS_TEST_NETWORK=1 is not set'
    ),
]

PROFILE = Path(__file__).resolve().parents[2] / 'config' / 'fastdds_network.xml'
PLAYED_S = 300.0
TRACKED = 0.8  # the wire is a process too, and takes much of one of the cores
MEDIAN_MS, P95_MS = 60.0, 150.0  # as on one machine, test_end_to_end.py
CAUGHT_UP_S = 60.0
KEYFRAME_BYTES = 640 * 480 * 5  # colour and depth


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    """Tracker, replay and observer on one machine, the mapper on the other."""
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(PROFILE))
    with wire.wired() as (here, there), Processes(tmp_path, 'SUBNET') as processes:
        with wire.entered(here):
            observer = Observer(processes.domain, discovery='SUBNET')
        at_home = wire.inside(here, own_shm=False)
        prefixes = {'tracker': at_home, 'replay': at_home, 'mapper': wire.inside(there)}
        try:
            yield Robot(processes, observer, tmp_path, sequence(), prefixes)
        finally:
            observer.close()


def test_every_pair_is_tracked_and_every_keyframe_arrives(robot: Robot) -> None:
    robot.tracker(node__resume=False)
    robot.mapper()
    robot.wait_ready('tracker', 'mapper')
    observer = robot.observer
    assert robot.replay().wait(PLAYED_S) == 0
    wait_until(
        lambda: observer.value('dcgs_tracker', 'keyframes') > 0
        and observer.value('dcgs_tracker', 'keyframes_missing') == 0,
        CAUGHT_UP_S, 'every keyframe arrived',
    )  # fmt: skip
    needed = math.ceil(TRACKED * len(robot.source))
    assert len(observer.poses) >= needed, observer.status['dcgs_tracker'][2]
    median, p95 = np.percentile(observer.latencies_ms(), [50, 95])
    assert median < MEDIAN_MS and p95 < P95_MS
    keyframes = int(observer.value('dcgs_tracker', 'keyframes'))
    assert len(observer.keyframes) >= keyframes  # the mapper has views between them too
    # They came over the wire.
    assert wire.received_bytes(prefix_of(robot)) > keyframes * KEYFRAME_BYTES


def prefix_of(robot: Robot) -> str:
    """Namespace of the mapper."""
    name: str = robot.prefixes['mapper'][3]
    return name
