# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""TF behind its port. The wheels have no tf2_ros: a stand-in with its interface is used."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from geometry_msgs.msg import TransformStamped
from scipy.spatial.transform import Rotation

from dcgs_ros.nodes.transforms import NoTransforms, Tf2Transforms, Transforms, make_transforms

EXACT = 1e-12


class Log:
    """A node as far as transforms need one."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=self.warnings.append)


class UnknownFrameError(Exception):
    """tf2_ros.TransformException."""


class Broadcaster:
    def __init__(self, node: Any) -> None:
        node.sent = self.sent = getattr(node, 'sent', [])

    def sendTransform(self, transform: TransformStamped) -> None:
        self.sent.append((type(self).__name__, transform))


class StaticBroadcaster(Broadcaster):
    pass


class Buffer:
    def __init__(self) -> None:
        self.known: dict[tuple[str, str], TransformStamped] = {}
        self.asked_ns = 0  # 0: the latest there is

    def lookup_transform(self, target: str, source: str, when: Any) -> TransformStamped:
        self.asked_ns = when.nanoseconds
        if (target, source) not in self.known:
            raise UnknownFrameError
        return self.known[target, source]


@pytest.fixture
def tf2(monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = ModuleType('tf2_ros')
    module.Buffer = Buffer
    module.TransformBroadcaster = Broadcaster
    module.StaticTransformBroadcaster = StaticBroadcaster
    module.TransformException = UnknownFrameError

    def listen(buffer: Buffer, node: Any) -> object:
        node.buffer = buffer
        return object()

    module.TransformListener = listen
    monkeypatch.setitem(sys.modules, 'tf2_ros', module)


def transform(parent: str, child: str, T: NDArray[np.float64]) -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    t, r = message.transform.translation, message.transform.rotation
    t.x, t.y, t.z = T[:3, 3].tolist()
    r.x, r.y, r.z, r.w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return message


def test_without_tf2_ros_that_is_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'tf2_ros', None)
    node: Any = Log()
    transforms: Transforms = make_transforms(node)
    assert type(transforms) is NoTransforms
    transforms.send(TransformStamped())
    transforms.send_static([TransformStamped()])
    assert transforms.lookup('odom', 'camera_link') is None
    assert len(node.warnings) == 1 and 'TF' in node.warnings[0]


def test_where_there_is_tf2_ros_it_is_used(tf2: None) -> None:
    node: Any = Log()
    transforms = make_transforms(node)
    assert isinstance(transforms, Tf2Transforms)
    moving = transform('odom', 'camera_link', np.eye(4))
    fixed = transform('camera_link', 'optical', np.eye(4))
    transforms.send(moving)
    transforms.send_static([fixed])
    assert node.sent == [('Broadcaster', moving), ('StaticBroadcaster', [fixed])]
    assert node.warnings == []


def test_lookup_maps_the_child_to_its_parent(tf2: None) -> None:
    node: Any = Log()
    transforms = make_transforms(node)
    assert transforms.lookup('base', 'camera') is None
    T_base_cam = np.eye(4)
    T_base_cam[:3, :3] = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
    T_base_cam[:3, 3] = 0.1, -0.2, 0.5
    node.buffer.known['base', 'camera'] = transform('base', 'camera', T_base_cam)
    found = transforms.lookup('base', 'camera')
    assert found is not None
    np.testing.assert_allclose(found, T_base_cam, atol=EXACT)
    assert node.buffer.asked_ns == 0
    assert transforms.lookup('base', 'camera', 1_700_000_000_000_000_001) is not None
    assert node.buffer.asked_ns == 1_700_000_000_000_000_001
