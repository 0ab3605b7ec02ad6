# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The mapper node: keyframes in, the map and views of it out.

The executor's thread receives and joins; one other thread, which gives way to all others of the
machine, maps and publishes.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from std_srvs.srv import Trigger

from ..core.config.nodes import MapperSettings, core_config
from ..core.config.presets import ONLINE
from ..core.config.schema import override
from ..core.errors import DcgsError
from ..core.kernels.workers import give_way
from ..core.mapping.warmup import warm_up_with_mapper
from ..core.tracking.warmup import ANY_CAMERA
from ..io.ros_images import stamp_ns
from .lifetime import Worker, run
from .mapping.outputs import MapOutputs
from .mapping.session import Mapping
from .messages.keyframes import TOPICS, read_keyframe
from .messages.poses import matrix
from .messages.standard import diagnostics, status
from .parameters import Parameters
from .tracking.health import LOADING, Level
from .tracking.pairing import Joiner
from .transport import RELIABLE
from .work_queue import WorkQueue

_WAITING_KEYFRAMES = 32
_INCOMPLETE = 16  # stamps of which some topics are still on their way
_PAUSE_S = 0.01
_BEHIND = 8  # waiting keyframes that are worth a warning
_THROTTLE_S = 5.0
_LIVE = ('mapping', 'rates')


class MapperNode(Node):
    """Photorealistic map from a tracker's keyframes."""

    def __init__(self) -> None:
        """Subscribe, and start the thread."""
        super().__init__('dcgs_mapper')
        defaults = override(MapperSettings(), ONLINE)
        self._params = Parameters(self, defaults, _is_live, self._reconfigure)
        settings = self._params.settings
        self._mapping = Mapping(core_config(settings), self._say)
        self._outputs = MapOutputs(self, settings.node)
        self._joiner = Joiner(tuple(TOPICS), _INCOMPLETE)
        self._inbox: WorkQueue[dict[str, Any]] = WorkQueue(_WAITING_KEYFRAMES)
        self._pose: PoseStamped | None = None
        self._taken_s: float | None = None
        self._ready = False
        for name, kind in TOPICS.items():
            self.create_subscription(
                kind, f'keyframe/{name}', partial(self._on_part, name), RELIABLE
            )
        self.create_subscription(PoseStamped, 'dcgs_tracker/camera_pose', self._on_pose, RELIABLE)
        self.create_service(Trigger, '~/save_map', self._on_save)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self._health = self.create_publisher(DiagnosticArray, '/diagnostics', RELIABLE)
        self.create_timer(1.0, self._report)
        self._worker = Worker(self, self._work, 'mapping')

    def _on_part(self, name: str, message: Any) -> None:
        parts = self._joiner.add(name, stamp_ns(message.header.stamp), message)
        if parts is not None:
            self._inbox.put(parts)

    def _on_pose(self, pose: PoseStamped) -> None:
        self._pose = pose

    def _on_save(self, _: Any, response: Any) -> Any:
        folder = Path(self._params.settings.node.save_folder)
        return self._answered(response, partial(self._mapping.save, folder))

    def _on_reset(self, _: Any, response: Any) -> Any:
        return self._answered(response, self._reset)

    def _answered(self, response: Any, work: Any) -> Any:
        """Have the mapping thread do it, and say what came of it."""
        try:
            response.message = self._inbox.order(work).result()
            response.success = True
        except DcgsError as error:
            response.message = str(error)
        return response

    def _reset(self) -> str:
        self._mapping.reset()
        self._outputs.keyframes(None)
        self._outputs.update(None)
        return 'the map is empty; keyframes that the tracker keeps come again'

    def _reconfigure(self, settings: MapperSettings) -> None:
        self._inbox.order(lambda: self._mapping.reconfigure(core_config(settings)))

    def _work(self) -> None:
        """Insert what came, publish what is due, optimise otherwise; until closed."""
        give_way()
        outputs, mapping = self._outputs, self._mapping
        warm_up_with_mapper(ANY_CAMERA, self._params.settings)
        self._ready = True
        self.get_logger().info('ready')
        outputs.keyframes(None)  # tells a tracker that is there already what to offer
        busy = False
        while not self._inbox.closed:
            parts = self._inbox.take(0.0 if busy else _PAUSE_S)
            if parts is not None:
                self._insert(parts)
            outputs.update_when_due(mapping.mapper)
            if outputs.render_due() and self._pose is not None:
                self._render(self._pose)
            busy = parts is not None or mapping.advance()

    def _insert(self, parts: dict[str, Any]) -> None:
        mapping = self._mapping
        try:
            offer = read_keyframe(parts)
        except DcgsError as error:
            mapping.refused += 1
            self._say(f'keyframe refused: {error}')
            return
        update = mapping.take(offer)
        if update is not None:
            self._taken_s = time.monotonic()
            self._outputs.answer(update, offer.keyframe.frame.stamp_ns)
        self._outputs.keyframes(mapping.mapper)

    def _render(self, pose: PoseStamped) -> None:
        try:
            stamp = stamp_ns(pose.header.stamp)
            rendering = self._mapping.view(stamp, matrix(pose.pose))
        except DcgsError as error:
            self._say(f'cannot render: {error}')
            return
        if rendering is not None:
            self._outputs.rendering(rendering, stamp)

    def _say(self, text: str) -> None:
        self.get_logger().warning(text, throttle_duration_sec=_THROTTLE_S)

    def _report(self) -> None:
        """Publish how mapping goes."""
        mapping, mapper, waiting = self._mapping, self._mapping.mapper, len(self._inbox)
        level, text = Level.OK, 'mapping'
        if not self._ready:
            level, text = LOADING.level, LOADING.message
        elif mapper is None or self._taken_s is None:
            level, text = Level.WARN, 'no keyframes yet: is the tracker running and tracking?'
        elif waiting > _BEHIND:
            level, text = Level.WARN, f'{waiting} keyframes wait: the mapper is behind'
        values: dict[str, object] = {
            'waiting': waiting,
            'dropped': self._inbox.dropped,
            'incomplete': self._joiner.dropped,
            'refused': mapping.refused,
            'steps_per_s': mapping.steps_per_s,
        }
        if mapper is not None:
            values |= {
                'gaussians': len(mapper.table),
                'keyframes': len(mapper.views),
                'steps': mapper.steps,
                'poisoned': mapper.poisoned,
            }
        if self._taken_s is not None:
            values['s_since_keyframe'] = time.monotonic() - self._taken_s
        report = status(bytes([level]), 'dcgs_mapper: mapping', text, values)
        self._health.publish(diagnostics(self.get_clock().now().to_msg(), [report]))

    def close(self) -> None:
        """End the thread; save the map where that was asked for."""
        self._inbox.close()
        self._worker.join()
        node = self._params.settings.node
        if node.save_on_exit:
            try:
                self.get_logger().info(self._mapping.save(Path(node.save_folder)))
            except DcgsError as error:
                self.get_logger().error(f'map not saved: {error}')
        self._mapping.close()


def _is_live(key: str) -> bool:
    """Tell which settings may change while mapping."""
    stage, _, name = key.partition('.')
    return stage in _LIVE and name not in ('seed', 'ssim_weight', 'depth_weight')


def main() -> int:
    """Run the node until it is told to stop."""
    return run(MapperNode)
