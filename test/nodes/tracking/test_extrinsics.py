# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Where the camera is on the base: by setting, by TF, or looking forward."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

pytest.importorskip('rclpy')

from geometry_msgs.msg import TransformStamped

from dcgs_ros.core import se3
from dcgs_ros.core.config.nodes import TrackerNodeSettings
from dcgs_ros.core.config.schema import ConfigError
from dcgs_ros.nodes.tracking import extrinsics
from dcgs_ros.nodes.tracking.extrinsics import LOOKING_FORWARD, Mounting, known_extrinsics

CAMERA = 'camera_color_optical_frame'
EXACT = 1e-12
TEXT = 1e-3  # of what a quaternion may be off in length


class Known:
    """TF that knows one transform, or none."""

    listens = True

    def __init__(self, T: NDArray[np.float64] | None) -> None:
        self.T, self.asked = T, list[tuple[str, str]]()

    def send(self, transform: TransformStamped) -> None:
        raise AssertionError('nothing is to be sent')

    send_static = send

    def lookup(
        self, parent: str, child: str, stamp_ns: int | None = None
    ) -> NDArray[np.float64] | None:
        self.asked.append((parent, child))
        return self.T


def found(
    text: str = 'auto', T: NDArray[np.float64] | None = None, base: str = 'base_link'
) -> NDArray[np.float64]:
    settings = replace(TrackerNodeSettings(), base_to_camera=text, base_frame=base)
    known = known_extrinsics(settings, Known(T), CAMERA)
    assert known is not None
    return known


def test_looking_forward_the_camera_is_upright() -> None:
    """REP 103: forward is x of the base and z of the optical frame."""
    T = LOOKING_FORWARD
    axes = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]).T  # of right, down, forward in the base
    np.testing.assert_allclose(T[:3, :3], axes, atol=EXACT)
    np.testing.assert_array_equal(T[:, 3], [0, 0, 0, 1])


def test_tf_is_asked_for_the_camera_on_the_base() -> None:
    T, settings = se3.exp(np.array([0.1, 0.2, 0.3, -0.5, 0.6, 0.7])), TrackerNodeSettings()
    known = Known(T)
    np.testing.assert_array_equal(known_extrinsics(settings, known, CAMERA), T)
    assert known.asked == [('camera_link', CAMERA)]
    assert known_extrinsics(settings, Known(None), CAMERA) is None


def test_a_setting_counts_more_than_tf() -> None:
    T = found('1 2 3 0 0 0 1', T=np.full((4, 4), 7.0))
    np.testing.assert_array_equal(T, [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


def test_a_base_that_is_the_camera_is_where_it_is() -> None:
    np.testing.assert_array_equal(found(T=np.full((4, 4), 7.0), base=CAMERA), np.eye(4))


@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6), st.floats(-0.9, 0.9))
def test_any_pose_can_be_written_down(xi: list[float], off: float) -> None:
    T = se3.exp(np.array(xi))
    w, x, y, z = se3.to_quaternion(T) * (1 + off * TEXT)
    for separator in (' ', ', ', ' , '):
        text = separator.join(f'{n:.12f}' for n in (*T[:3, 3], x, y, z, w))
        R = found(text)[:3, :3]
        np.testing.assert_allclose(found(text), T, atol=1e-9)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=EXACT)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(
    'text',
    ['', 'none', '1 2 3', '0 0 0 0 0 0 0', '0 0 0 1 1 1 1', '0 0 0 0 0 0 1 0', '0 0 0 0 0 0 one',
     'nan 0 0 0 0 0 1', '0 0 inf 0 0 0 1', '0 0 0 nan 0 0 1', '0 0 0 0 0 0 inf', '1;2;3;0;0;0;1',
     '0 0 0 0 0 0 0.99', 'AUTO'],
)  # fmt: skip
def test_what_is_no_pose_is_refused_and_shown(text: str) -> None:
    with pytest.raises(ConfigError) as refused:
        found(text)
    assert repr(text) in str(refused.value) and 'qx qy qz qw' in str(refused.value)


class Waiting:
    """A `Mounting`, its clock, and what it says."""

    def __init__(self, wait_s: float, patch: pytest.MonkeyPatch, listens: bool = True) -> None:
        self.tf, self.now_s, self.said = Known(None), 100.0, list[str]()
        self.tf.listens = listens
        patch.setattr(extrinsics.time, 'monotonic', lambda: self.now_s)
        settings = replace(TrackerNodeSettings(), wait_for_transform_s=wait_s)
        self.mounting = Mounting(settings, self.tf, self.said.append)

    def after(self, passed_s: float) -> NDArray[np.float64] | None:
        self.now_s += passed_s
        to_base = self.mounting.find(CAMERA)
        return None if to_base is None else to_base.T_base_cam

    @property
    def doubt(self) -> str:
        return self.mounting.doubt or ''


def test_tf_is_waited_for_and_that_is_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = Waiting(5.0, monkeypatch)
    assert [waiting.after(1.0) for _ in range(4)] == [None] * 4
    assert len(waiting.said) == 1 and f'waiting for TF from camera_link to {CAMERA}' in str(
        waiting.said
    )
    assert waiting.doubt == waiting.said[0] and '5 s' in waiting.said[0]
    waiting.tf.T = se3.exp(np.full(6, 0.2))
    assert waiting.after(1.0) is waiting.tf.T
    assert waiting.doubt == ''


def test_what_never_comes_is_assumed_loudly_and_still_taken_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waiting = Waiting(5.0, monkeypatch)
    assert waiting.after(0.0) is None
    for _ in range(3):
        assert waiting.after(5.1) is LOOKING_FORWARD
    assert len(waiting.said) == 2 and 'wrong unless' in waiting.said[1]
    assert 'node.base_to_camera' in waiting.said[1] == waiting.doubt
    waiting.tf.T = se3.exp(np.full(6, 0.2))
    assert waiting.after(1.0) is waiting.tf.T
    assert waiting.doubt == '' and 'has come' in waiting.said[2]
    asked = len(waiting.tf.asked)
    assert waiting.after(9.0) is waiting.tf.T and len(waiting.tf.asked) == asked


def test_tf_is_not_asked_at_every_image(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = Waiting(1.0, monkeypatch)
    for _ in range(60):
        waiting.after(0.01)
    assert len(waiting.tf.asked) < 6


def test_without_tf_nothing_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = Waiting(5.0, monkeypatch, listens=False)
    assert waiting.after(0.0) is LOOKING_FORWARD
    assert len(waiting.said) == 1 and 'node.base_to_camera' in waiting.said[0]
    assert waiting.doubt == ''  # nothing better will come
    assert Waiting(0.0, monkeypatch).after(0.0) is LOOKING_FORWARD
