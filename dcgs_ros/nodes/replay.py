# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The replay node: a recording on the topics of a camera, at its own pace.

One thread reads and converts ahead, one publishes; the executor serves parameters.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, Imu
from std_msgs.msg import Header

from ..core.config.nodes import ReplaySettings
from ..datasets.bag.messages import read_header
from ..datasets.prefetch import prefetch
from ..io.ros_images import stamp_ns
from .lifetime import Worker, run
from .messages.images import header, time_message
from .messages.poses import transform_stamped
from .parameters import Parameters
from .playback.pursuit import Pursuit
from .playback.schedule import Pacer, ScheduledItem, schedule
from .playback.sources import Output, open_playback
from .transforms import make_transforms
from .transport import RELIABLE, sensor_qos

_IMAGES: dict[Output, tuple[type, str]] = {
    'camera_info': (CameraInfo, 'camera/camera/color/camera_info'),
    'color': (Image, 'camera/camera/color/image_raw'),
    'depth': (Image, 'camera/camera/aligned_depth_to_color/image_raw'),
}
_BESIDE: dict[Output, tuple[type, str]] = {
    'imu': (Imu, 'camera/camera/imu'),
    'gyro': (Imu, 'camera/camera/gyro/sample'),
    'accel': (Imu, 'camera/camera/accel/sample'),
    'odometry': (Odometry, 'odom'),
}
_POLL_S = 0.05
_SAY_S = 10.0  # how often it is said what is waited for
_WHEN_READY = 'a tracker subscribes once its kernels are loaded (the first time: compiled)'
_UNACKNOWLEDGED = 4  # frames to publish before waiting, as fast as possible: fewer than are kept
_ACKNOWLEDGE_WAIT = Duration(seconds=2)
_AHEAD = 4  # frames, of the tracker that is played to: as many as it keeps
_QUEUE, _SAMPLES = 5, 200  # images and samples that wait to be sent
_SAMPLES_PER_FRAME = 10  # of an IMU and wheels at usual rates
_PATIENCE_S = 5.0  # with that tracker, if it says nothing


class ReplayNode(Node):
    """A recording in place of a camera."""

    def __init__(self) -> None:
        """Open the recording, and start to play it."""
        super().__init__('dcgs_replay')
        self._settings = Parameters(
            self, ReplaySettings(), live=lambda _: False, on_change=lambda _: None
        ).settings
        s = self._settings
        camera = None if s.camera == 'auto' else s.camera
        self._source = open_playback(s.source, camera, s.base_frame, s.color_frame, self._warn)
        beside = {output: _BESIDE[output] for output in self._source.beside}
        self._outputs: dict[Output, Publisher] = {
            output: self.create_publisher(
                type_, topic, sensor_qos(s.reliability, _SAMPLES if output in beside else _QUEUE)
            )
            for output, (type_, topic) in (_IMAGES | beside).items()
        }
        self._clock_output = self.create_publisher(Clock, '/clock', RELIABLE)
        make_transforms(self).send_static(
            [transform_stamped(T, header(0, up), down) for up, down, T in self._source.mounts]
        )
        self._stop, self._pursuit = threading.Event(), Pursuit(_AHEAD, _PATIENCE_S)
        if s.wait_for_node:
            progress = f'{s.wait_for_node}/progress'
            self.create_subscription(Header, progress, self._on_progress, RELIABLE)
        self._worker = Worker(self, self._work, 'replay')

    def _work(self) -> None:
        """Play, then end the process."""
        if self._await_subscribers():
            self._play()
        self.context.try_shutdown()

    def _await_subscribers(self) -> bool:
        """Wait for those who have to subscribe, saying so; return False if told to end before."""
        said_s = -_SAY_S
        while (lacking := self._lacking()) is not None:
            if time.monotonic() - said_s >= _SAY_S:
                said_s = time.monotonic()
                self.get_logger().info(f'waiting for {lacking}')
            if self._stop.wait(_POLL_S):
                return False
        return True

    def _lacking(self) -> str | None:
        """Return who has to subscribe to what before the playback begins; None: nobody."""
        wanted, node = self._settings.wait_for_subscribers, self._settings.wait_for_node
        for output in (self._outputs[name] for name in _IMAGES):
            topic, count = output.topic_name, output.get_subscription_count()
            subscribers = self.get_subscriptions_info_by_topic(topic) if node else []
            if node and node not in [info.node_name for info in subscribers]:
                return f'{node} to subscribe to {topic}: {_WHEN_READY}'
            if count < wanted:
                return f'{wanted} subscribers of {topic}, which has {count}: {_WHEN_READY}'
        return None

    def _play(self) -> None:
        """Publish every item when it is due."""
        s = self._settings
        self.get_logger().info(f'playing {s.source}')
        start_s, count = time.monotonic(), 0
        pacer = Pacer(s.rate, self._publish_clock, self._stop)
        ahead = _AHEAD * (_SAMPLES_PER_FRAME if self._source.beside else 1)
        with closing(prefetch(self._converted(), ahead)) as ready:
            for scheduled, messages in ready:
                if not pacer.wait(scheduled):
                    return
                for output, message in messages:
                    if output == 'color':
                        self._keep_near(message)
                        count += 1
                    self._outputs[output].publish(message)
                if not s.rate and count % _UNACKNOWLEDGED == 0:
                    self._await_acknowledgement('color', 'depth')
        self._await_acknowledgement(*self._outputs)
        self.get_logger().info(f'{count} frames in {time.monotonic() - start_s:.1f} s')

    def _keep_near(self, color: Any) -> None:
        """Wait, where a tracker is played to, until it can take another frame."""
        if self._settings.wait_for_node:
            if not self._pursuit.wait():
                self._warn(f'{self._settings.wait_for_node} says nothing: it is not waited for')
            raw = isinstance(color, bytes)
            self._pursuit.played(read_header(color)[0] if raw else stamp_ns(color.header.stamp))

    def _on_progress(self, done: Header) -> None:
        self._pursuit.tracked(stamp_ns(done.stamp))

    def _converted(self) -> Iterator[tuple[ScheduledItem[Any], list[tuple[Output, Any]]]]:
        """Yield the items of the whole playback with their messages."""
        s = self._settings
        items = schedule(self._source.items, s.start_s, s.duration_s, s.loop, s.continuous_stamps)
        for scheduled in items:
            yield scheduled, self._source.messages(scheduled.item, scheduled.shift_ns)

    def _await_acknowledgement(self, *outputs: Output) -> None:
        """Wait until all reliable subscribers have what was published, at most two seconds."""
        for output in outputs:
            self._outputs[output].wait_for_all_acked(_ACKNOWLEDGE_WAIT)

    def _publish_clock(self, clock_ns: int) -> None:
        if self._settings.clock:
            self._clock_output.publish(Clock(clock=time_message(clock_ns)))

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)

    def close(self) -> None:
        """End the playback."""
        self._stop.set()
        self._pursuit.end()
        self._worker.join()


def main() -> int:
    """Replay to the end, or until told to stop."""
    return run(ReplayNode)
