# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The tracker node: RGB-D images in, odometry and keyframes out.

The executor's thread receives and pairs images, a second thread tracks, a third sends keyframes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from std_srvs.srv import Trigger

from ..core.config.nodes import TrackerSettings, core_config
from ..core.config.presets import ONLINE
from ..core.config.schema import override
from ..core.errors import DcgsError
from ..core.keyframe import MapUpdate
from ..core.tracking.result import TrackingState
from ..core.tracking.warmup import ANY_CAMERA, warm_up
from .health import LOADING
from .lifetime import Worker, run
from .messages.diagnostics import diagnostics
from .parameters import Parameters
from .tracking.camera_subscriber import CameraSubscriber
from .tracking.frame_reader import SomeImage
from .tracking.health import judge
from .tracking.keyframe_publisher import KeyframePublisher
from .tracking.keyframe_sender import KeyframeSender
from .tracking.mapper_subscriber import MapperSubscriber
from .tracking.outputs import TrackerOutputs
from .tracking.pairing import ImagePair
from .tracking.session import TrackingSession
from .transport import RELIABLE

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
        node_settings = settings.node
        self._outputs = TrackerOutputs(self, node_settings)
        self._camera = CameraSubscriber(self, node_settings, self._warn, self._outputs.lookup)
        self._session = TrackingSession(core_config(settings), np.eye(4), self._warn)
        publisher = KeyframePublisher(self, self._outputs.world)
        memory_mb = node_settings.keyframe_memory_mb
        self._sender = KeyframeSender(publisher, memory_mb, self._session.alive)
        self._mapper = MapperSubscriber(
            self, self._on_answer, self._sender.acknowledge, self._warn
        )
        self.create_service(Trigger, '~/reset', self._on_reset)
        self._health = self.create_publisher(DiagnosticArray, '/diagnostics', RELIABLE)
        self.create_timer(1.0, self._report)
        self._ready = False
        self._worker = Worker(self, self._work, 'tracking')

    def _on_answer(self, update: MapUpdate, epoch: int) -> None:
        self._camera.queue.submit(lambda: self._session.apply(update, epoch))

    def _on_reset(self, _: Any, response: Any) -> Any:
        self._camera.queue.submit(self._reset).result()
        response.success, response.message = True, 'the next frame begins a new map'
        return response

    def _reset(self) -> None:
        self._session.reset()
        self._sender.forget()
        self._outputs.forget()

    def _reconfigure(self, settings: TrackerSettings) -> None:
        config = core_config(settings)
        self._camera.queue.submit(lambda: self._session.reconfigure(config))

    def _work(self) -> None:
        """Load the kernels, then track every pair until closed."""
        warm_up(ANY_CAMERA, self._params.settings)
        self._camera.warm_up()
        self._resume()
        self._ready = True
        self.get_logger().info('ready')
        queue = self._camera.queue
        while not queue.closed:
            pair = queue.take(0.2)
            if pair is None or not self._camera.reader.has_camera:
                continue
            try:
                self._track(pair)
            except DcgsError as error:
                self._session.refuse(error)

    def _resume(self) -> None:
        """Go on in the map of a mapper, if that is set and there is one."""
        settings = self._params.settings.node
        found = self._mapper.resumable(settings.resume_wait_s) if settings.resume else None
        if found is not None:
            self._session.resume(found)
            sizes = f'{len(found.rows)} Gaussians, {len(found.poses)} keyframes'
            self.get_logger().info(f'going on in a map of {sizes}')

    def _track(self, pair: ImagePair[SomeImage, SomeImage]) -> None:
        """Track a frame; publish its pose, then what the mapper should get."""
        per_metre = self._params.settings.node.depth_per_metre
        frame, camera = self._camera.reader.read(pair, per_metre)
        camera_frame = pair.color.header.frame_id
        session, to_base = self._session, self._outputs.camera_to_base(camera_frame)
        session.T_world_first = to_base.T_base_cam
        epoch = session.epoch
        result = session.track(frame, camera)
        if result is None:
            return
        if session.epoch != epoch:
            self._sender.forget()
        if result.state is not TrackingState.LOST:
            self._outputs.publish(result, to_base)
        for packet in session.packets(frame, result, camera_frame):
            self._sender.put(packet)

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text, throttle_duration_sec=_THROTTLE_S)

    def _report(self) -> None:
        """Publish how tracking goes."""
        session, news = self._session, self._camera.news()
        verdict = judge(news, session.result, session.searching) if self._ready else LOADING
        values = {
            'ms': session.ms, **self._camera.figures(), **session.counts,
            **self._sender.figures(), **session.figures(),
        }  # fmt: skip
        name, stamp = f'{self.get_name()}: tracking', self.get_clock().now().to_msg()
        self._health.publish(diagnostics(stamp, name, verdict, values))

    def close(self) -> None:
        """End the threads; write the trajectory if that is set."""
        self._camera.queue.close()
        self._worker.join()
        self._sender.close()
        written = self._outputs.close()
        if written is not None:
            self.get_logger().info(written)


def _is_live(key: str) -> bool:
    """Return whether a setting may change while tracking."""
    return key.split('.')[0] not in _FIXED


def main() -> int:
    """Run the node until it is told to stop."""
    return run(TrackerNode)
