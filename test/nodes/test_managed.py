# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Nodes are configured, activated and cleaned up by another node, or start by themselves."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip('rclpy')

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from std_msgs.msg import Header

from dcgs_ros.core.errors import DcgsError
from dcgs_ros.nodes import mapper
from dcgs_ros.nodes.managed import INACTIVE, UNCONFIGURED, ManagedNode
from dcgs_ros.nodes.mapper import MapperNode
from dcgs_ros.nodes.tracker import TrackerNode

HANGS_S = 60.0  # only a failure takes so long
DONE, FAILED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
IMAGES = {
    '/camera/camera/color/image_raw', '/camera/camera/aligned_depth_to_color/image_raw'
}  # fmt: skip

Make = Callable[..., Any]


class Example(ManagedNode):
    """Notes what it is asked to do."""

    def __init__(self, error: Exception | None = None) -> None:
        super().__init__('example')
        self.lasts = self.create_publisher(Header, 'lasts', 1)
        self.done: list[str] = []
        self._error = error

    def configure(self) -> None:
        self.create_publisher(Header, 'comes', 1)
        self.create_subscription(Header, 'comes', print, 1)
        self.create_timer(100.0, print)
        if self._error is not None:
            raise self._error
        self._ready = True
        self.done.append('configure')

    def activate(self) -> None:
        self.done.append('activate')

    def deactivate(self) -> None:
        self.done.append('deactivate')

    def end(self) -> None:
        self.done.append('end')


def topics(node: Node) -> set[str]:
    entities: list[Any] = [*node.publishers, *node.subscriptions]
    return {entity.topic_name for entity in entities}


def test_each_transition_does_its_part_and_a_clean_up_undoes_the_first(make: Make) -> None:
    one = make(Example)
    before = topics(one)
    for _ in range(2):
        assert one.trigger_configure() is DONE and '/comes' in topics(one)
        assert one.trigger_activate() is DONE and one.active
        assert one.trigger_deactivate() is DONE and not one.active
        assert one.trigger_cleanup() is DONE and not one.configured
        assert topics(one) == before and '/lasts' in before and not list(one.timers)
    assert one.done == ['configure', 'activate', 'deactivate', 'end'] * 2


def test_it_ends_once_however_it_ends(make: Make) -> None:
    one = make(Example)
    one.close()
    assert not one.done
    one.autostart()
    assert one.trigger_shutdown() is DONE
    one.close()
    assert one.done == ['configure', 'activate', 'end']


def test_what_cannot_be_configured_says_why_and_stays_as_it_was(
    make: Make, capfd: pytest.CaptureFixture[str]
) -> None:
    one = make(lambda: Example(DcgsError('no such map')))
    before = topics(one)
    with pytest.raises(DcgsError, match='no such map'):  # which `run` prints
        one.autostart()
    assert 'no such map' not in capfd.readouterr().err
    assert one.trigger_configure() is FAILED
    assert 'not configured: no such map' in capfd.readouterr().err
    assert topics(one) == before and not one.configured
    one._error = None
    assert one.trigger_configure() is DONE


def test_while_kernels_are_loaded_nothing_is_cleaned_up(make: Make) -> None:
    one = make(Example)
    one.trigger_configure()
    one._ready = False
    assert one.trigger_cleanup() is FAILED and one.configured and not one.done[1:]
    one._ready = True
    assert one.trigger_cleanup() is DONE


def test_a_tracker_that_is_managed_looks_at_images_while_it_is_active(make: Make) -> None:
    eye = make(TrackerNode, '-p', 'node.autostart:=false')
    before = topics(eye)
    assert eye._judged()[0] is UNCONFIGURED and '/dcgs_tracker/odometry' not in before
    for _ in range(2):
        assert eye.trigger_configure() is DONE
        eye._camera.begin()  # its thread, once the kernels are loaded
        eye._ready = True
        assert '/dcgs_tracker/odometry' in topics(eye) and not IMAGES & topics(eye)
        assert eye._judged()[0] is INACTIVE
        with pytest.raises(DcgsError, match='not active'):
            eye._on_resume().result(0)
        assert eye.trigger_activate() is DONE and topics(eye) >= IMAGES
        assert eye.trigger_deactivate() is DONE and not IMAGES & topics(eye)
        assert eye.trigger_cleanup() is DONE
        assert topics(eye) == before and eye._judged()[0] is UNCONFIGURED


def test_a_mapper_that_is_managed_maps_while_it_is_active(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    brain, inserted, told = (
        make(MapperNode, '-p', 'node.autostart:=false'),
        list[Any](),
        list[Any](),
    )
    assert brain._judged()[0] is UNCONFIGURED
    assert brain.trigger_configure() is DONE
    monkeypatch.setattr(mapper, 'warm_up_with_mapper', lambda *_: None)
    monkeypatch.setattr(mapper, 'give_way', lambda nice: None)
    brain._navigation.warm_up = lambda: None
    brain._insert = inserted.append
    brain._outputs.keyframes = told.append
    queue, take = brain._queue, brain._queue.take
    steps = iter(['inactive', 'active', 'end'])

    def taken(timeout_s: float) -> Any:
        step = next(steps)
        if step == 'active':
            assert brain._judged()[0] is INACTIVE
            brain.trigger_activate()
        elif step == 'end':
            queue.close()
        take(0.0)
        return step

    queue.take = taken
    brain._work()
    assert inserted == ['active', 'end'] and len(told) == 2  # as it begins, and is activated


def test_another_node_drives_it_by_services(make: Make) -> None:
    """As nav2's lifecycle manager does."""
    one, other = make(Example), make(lambda: Node('manager'))
    executor = SingleThreadedExecutor()
    for node in (one, other):
        executor.add_node(node)

    def call(kind: Any, name: str, request: Any) -> Any:
        client, end = other.create_client(kind, f'/example/{name}'), time.monotonic() + HANGS_S
        while not client.service_is_ready():
            executor.spin_once(timeout_sec=0.05)
            assert time.monotonic() < end
        future = client.call_async(request)
        executor.spin_until_future_complete(future, HANGS_S)
        return future.result()

    for transition, state in (
        (Transition.TRANSITION_CONFIGURE, 'inactive'),
        (Transition.TRANSITION_ACTIVATE, 'active'),
        (Transition.TRANSITION_DEACTIVATE, 'inactive'),
        (Transition.TRANSITION_CLEANUP, 'unconfigured'),
    ):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert call(ChangeState, 'change_state', request).success
        assert call(GetState, 'get_state', GetState.Request()).current_state.label == state
    assert one.done == ['configure', 'activate', 'deactivate', 'end']
    executor.shutdown()
