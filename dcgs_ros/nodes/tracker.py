# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The tracker node: RGB-D images in, odometry and keyframes out.

The executor's thread receives and pairs; one other thread tracks; a third one sends keyframes.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from ..core.camera import PinholeCamera
from ..core.config.nodes import TrackerSettings, core_config
from ..core.config.presets import ONLINE
from ..core.config.schema import override
from ..core.errors import DcgsError
from ..core.frame import RgbdFrame
from ..core.tracking.tracker import TrackingState, TrackResult
from ..core.tracking.warmup import ANY_CAMERA, warm_up
from ..core.trajectory import Trajectory
from ..io.ros_images import MessageError
from ..io.trajectory import write_tum
from .lifetime import Worker, run
from .messages.clouds import KEYFRAME_POSE, read_cloud
from .messages.keyframes import read_answer
from .messages.maps import read_stamps
from .messages.odometry import Body
from .messages.standard import diagnostics, status
from .parameters import Parameters
from .tracking.camera_subscriber import CameraSubscriber, read_frame
from .tracking.extrinsics import base_to_camera, given_extrinsics
from .tracking.health import LOADING, judge, numbers
from .tracking.keyframe_publisher import KeyframePublisher
from .tracking.keyframe_sender import KeyframePacket, KeyframeSender
from .tracking.outputs import TrackerOutputs
from .tracking.session import Tracking
from .transforms import make_transforms
from .transport import RELIABLE, latched

_THROTTLE_S = 5.0
_FIXED = ('sensor', 'timing', 'ablation', 'shared_klt_weight', 'threads', 'node')


class TrackerNode(Node):
    """Odometry from an RGB-D camera."""

    def __init__(self) -> None:
        """Subscribe, and start the threads."""
        super().__init__('dcgs_tracker')
        defaults = override(TrackerSettings(), ONLINE)
        self._params = Parameters(self, defaults, _is_live, self._reconfigure)
        settings = self._params.settings
        self._settings = settings.node
        given_extrinsics(settings.node)  # what cannot be is to be told at the start
        self._transforms = make_transforms(self)
        self._outputs = TrackerOutputs(self, settings.node, self._transforms)
        self._link = KeyframePublisher(self, self._outputs.world)
        self._intake = CameraSubscriber(self, settings.node, self._say)
        self._tracking = Tracking(core_config(settings), np.eye(4), self._say)
        self._offers = KeyframeSender(
            self._link, settings.node.keyframe_memory_mb, self._tracking.alive
        )
        self._body: Body | None = None
        self._ready, self._ms = False, 0.0
        self._result: TrackResult | None = None
        self._way: list[tuple[int, NDArray[np.float64]]] = []  # to be saved
        self.create_subscription(PointCloud2, 'keyframe/answer', self._on_answer, RELIABLE)
        self.create_subscription(
            PointCloud2, 'dcgs_mapper/keyframes', self._on_keyframes, latched(1)
        )
        self.create_service(Trigger, '~/reset', self._on_reset)
        self._health = self.create_publisher(DiagnosticArray, '/diagnostics', RELIABLE)
        self.create_timer(1.0, self._report)
        self._worker = Worker(self, self._work, 'tracking')

    def _on_answer(self, cloud: PointCloud2) -> None:
        try:
            epoch, update = read_answer(cloud)
        except MessageError as error:
            self._say(f'answer of the mapper refused: {error}')
            return
        self._intake.inbox.order(lambda: self._tracking.answer(update, epoch))

    def _on_keyframes(self, cloud: PointCloud2) -> None:
        """Learn which keyframes the mapper has."""
        try:
            rows = read_cloud(cloud, KEYFRAME_POSE)
        except MessageError as error:
            self._say(f'keyframes of the mapper refused: {error}')
            return
        self._offers.acknowledge(read_stamps(rows))

    def _on_reset(self, _: Any, response: Any) -> Any:
        """Begin a new map."""
        self._intake.inbox.order(self._reset).result()
        response.success, response.message = True, 'the next frame begins a new map'
        return response

    def _reset(self) -> None:
        self._tracking.reset()
        self._offers.forget()
        self._outputs.forget()

    def _reconfigure(self, settings: TrackerSettings) -> None:
        self._intake.inbox.order(lambda: self._tracking.reconfigure(core_config(settings)))

    def _work(self) -> None:
        """Load the kernels, then track what comes, until closed."""
        warm_up(ANY_CAMERA, self._params.settings)
        if self._settings.resume:
            found = self._link.resumable(self._settings.resume_wait_s)
            if found is not None:
                self._tracking.resume(found)
                self.get_logger().info(
                    f'going on in a map of {len(found.rows)} Gaussians, {len(found.poses)} '
                    'keyframes'
                )
        self._ready = True
        self.get_logger().info('ready')
        intake = self._intake
        while not intake.inbox.closed:
            pair = intake.inbox.take(0.2)
            if pair is None or intake.camera is None:
                continue
            try:
                self._follow(read_frame(pair), intake.camera, pair.color.header.frame_id)
            except DcgsError as error:
                self._result = None
                self._tracking.counts['refused'] += 1
                self._say(f'frame refused: {error}')

    def _follow(self, frame: RgbdFrame, camera: PinholeCamera, camera_frame: str) -> None:
        """Track a frame; publish its pose, then what the mapper should have of it."""
        tracking = self._tracking
        if self._body is None:
            T_base_cam = base_to_camera(self._settings, self._transforms, camera_frame)
            self._body, tracking.T_world_first = Body(T_base_cam), T_base_cam
        epoch, start = tracking.epoch, time.perf_counter()
        result = tracking.track(frame, camera)
        self._ms, self._result = 1e3 * (time.perf_counter() - start), result
        if result is None:
            return
        if tracking.epoch != epoch:
            self._offers.forget()
        if result.state is not TrackingState.LOST:
            self._outputs.publish(result, self._body)
            if self._settings.save_on_exit:
                self._remember(result.stamp_ns, self._body.pose(result.T_world_cam))
        self._link.camera_frame = camera_frame
        for posed in tracking.selected(frame, result):
            self._offers.put(KeyframePacket(tracking.epoch, camera, posed))

    def _remember(self, stamp_ns: int, T_world_base: NDArray[np.float64]) -> None:
        if self._way and stamp_ns <= self._way[-1][0]:  # a recording played once more
            self._way.clear()
        self._way.append((stamp_ns, T_world_base))

    def _say(self, text: str) -> None:
        self.get_logger().warning(text, throttle_duration_sec=_THROTTLE_S)

    def _report(self) -> None:
        """Publish how tracking goes."""
        tracking, tracker, result = self._tracking, self._tracking.tracker, self._result
        streams = self._intake.news()
        searching = tracker is not None and tracker.searching
        verdict = judge(streams, result, searching) if self._ready else LOADING
        values = {'ms': self._ms, **self._intake.figures(), **tracking.counts}
        values |= {
            'keyframes_missing': self._offers.missing,
            'views_left_out': self._offers.left_out,
            'offers_failed': self._offers.failed,
        }
        if tracker is not None:
            values |= {'gaussians': len(tracker.gaussians), 'keyframes': tracker.keyframes}
        if result is not None:
            values |= numbers(result)
        level = bytes([verdict.level])
        report = status(level, 'dcgs_tracker: tracking', verdict.message, values)
        self._health.publish(diagnostics(self.get_clock().now().to_msg(), [report]))

    def close(self) -> None:
        """End the threads; write the trajectory where that was asked for."""
        self._intake.inbox.close()
        self._worker.join()
        self._offers.close()
        if self._settings.save_on_exit and self._way:
            folder = Path(self._settings.save_on_exit)
            folder.mkdir(parents=True, exist_ok=True)
            stamps, poses = zip(*self._way, strict=True)
            write_tum(folder / 'trajectory.tum', Trajectory(np.array(stamps), np.array(poses)))
            self.get_logger().info(f'{len(stamps)} poses in {folder / "trajectory.tum"}')


def _is_live(key: str) -> bool:
    """Tell which settings may change while tracking."""
    return key.split('.')[0] not in _FIXED


def main() -> int:
    """Run the node until it is told to stop."""
    return run(TrackerNode)
