# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""ROS for tests: on this machine alone, in a domain of its own, with its own log folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]


@contextmanager
def environment(folder: Path) -> Iterator[dict[str, str]]:
    """Environment for processes that talk to each other and to nobody else."""
    pytest.importorskip('rclpy')
    from dcgs_ros.nodes.harness.processes import claim_domain

    claim, domain = claim_domain()
    with claim:
        yield {
            **os.environ,
            'PYTHONPATH': str(ROOT),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'ROS_DOMAIN_ID': str(domain),
            'ROS_LOG_DIR': str(folder),
            'FASTRTPS_DEFAULT_PROFILES_FILE': str(ROOT / 'config' / 'fastdds.xml'),
        }


@pytest.fixture
def ros_environment(tmp_path: Path) -> Iterator[dict[str, str]]:
    """Environment for a test's processes."""
    with environment(tmp_path / 'ros') as variables:
        yield variables


@pytest.fixture(scope='module')
def ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """ROS in this process, for nodes that nobody else has to see."""
    rclpy = pytest.importorskip('rclpy')
    folder = tmp_path_factory.mktemp('ros')
    with pytest.MonkeyPatch.context() as patch, environment(folder) as variables:
        for name, value in variables.items():
            patch.setenv(name, value)
        rclpy.init(args=[])
        yield
        rclpy.shutdown()


@pytest.fixture
def make(
    ros_environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Any]]:
    """Return a maker of nodes of this process, without their threads."""
    rclpy = pytest.importorskip('rclpy')
    from dcgs_ros.nodes import mapper, replay, tracker

    for name, value in ros_environment.items():
        monkeypatch.setenv(name, value)
    idle = SimpleNamespace(join=lambda: None, leave=lambda: None)
    for module in (tracker, mapper, replay):
        monkeypatch.setattr(module, 'Worker', lambda node, work, name: idle)
    nodes: list[Any] = []

    def made(kind: Callable[[], Any], *arguments: str) -> Any:
        if not rclpy.ok():
            rclpy.init(args=['--ros-args', *arguments])
        nodes.append(kind())
        return nodes[-1]

    yield made
    for node in nodes:
        getattr(node, 'close', lambda: None)()
        node.destroy_node()
    rclpy.try_shutdown()


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Any]:
    """Nodes to be started as processes, and an observer: a `robot.Robot`."""
    pytest.importorskip('rclpy')
    from robot import Robot, sequence  # type: ignore[import-not-found]

    from dcgs_ros.nodes.harness.observer import Observer
    from dcgs_ros.nodes.harness.processes import Processes

    with Processes(tmp_path) as processes:
        observer = Observer(processes.domain, with_map=True)
        try:
            yield Robot(processes, observer, tmp_path, sequence(), {})
        finally:
            observer.close()
