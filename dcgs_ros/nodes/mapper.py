# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The mapper node: keyframes in, the map and views of it out.

The executor's thread receives and joins messages; a second thread, of the lowest priority, maps
and publishes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2

from ..core.config.nodes import MapperSettings, core_config
from ..core.config.presets import ONLINE
from ..core.config.schema import override
from ..core.errors import DcgsError
from ..core.kernels.workers import give_way
from ..core.keyframe import Correction
from ..core.mapping.warmup import warm_up_with_mapper
from ..core.tracking.warmup import ANY_CAMERA
from ..io.ros_images import stamp_ns
from .health import LOADING, Verdict
from .lifetime import Worker, run
from .managed import INACTIVE, UNCONFIGURED, ManagedNode
from .mapping.keyframe_subscriber import KeyframeSubscriber
from .mapping.navigation import Navigation, Seen
from .mapping.outputs import MapOutputs
from .mapping.session import AFTER_RESET, MappingSession
from .messages.corrections import read_correction
from .messages.keyframes import read_keyframe
from .messages.poses import matrix
from .parameters import Parameters
from .reporter import Reporter
from .services import answered, offer, refused
from .transport import RELIABLE, latched

_PAUSE_S = 0.01
_LIVE = ('mapping', 'rates')
_FIXED = ('seed', 'ssim_weight', 'depth_weight')


class MapperNode(ManagedNode):
    """Photorealistic map from a tracker's keyframes."""

    def __init__(self) -> None:
        """Begin at once, unless another node is to say when."""
        super().__init__('dcgs_mapper')
        self._reporter = Reporter(self, 'mapping', self._judged)
        self._warn = self._reporter.warn
        defaults = override(MapperSettings(), ONLINE)
        self._params = Parameters(self, defaults, _is_live, self._reconfigure)
        if self._params.settings.node.autostart:
            self.autostart()

    def configure(self) -> None:
        """Subscribe, and start the thread, which maps once it is active."""
        settings = self._params.settings
        self._keyframes = KeyframeSubscriber(self)
        trackers = self._keyframes.trackers
        localizes = settings.node.mode == 'localization'
        self._session = MappingSession(core_config(settings), self._warn, trackers, localizes)
        if settings.node.map:
            self.get_logger().info(self._session.load(Path(settings.node.map)))
        elif localizes:
            raise DcgsError('node.mode is localization, but node.map names no map')
        self._autosave_s, self._autosaved = time.monotonic(), 0
        self._outputs = MapOutputs(self, settings.node)
        self._navigation = Navigation(self, settings)
        self._queue = self._keyframes.queue
        self._pose: PoseStamped | None = None  # latest of the camera
        self.create_subscription(PoseStamped, 'camera_pose', self._on_pose, RELIABLE)
        self.create_subscription(PointCloud2, 'keyframe_poses', self._on_poses, latched(1))
        offer(self, '~/save_map', lambda: self._when_ready(self._save))
        offer(self, '~/load_map', lambda: self._when_ready(self._load))
        offer(self, '~/reset', self._on_reset)
        self._worker = Worker(self, self._work, 'mapping')

    def activate(self) -> None:
        """Let the thread map; the tracker sends the keyframes that passed by meanwhile."""
        self._queue.submit(lambda: self._outputs.keyframes(self._session.mapper))

    def deactivate(self) -> None:
        """Let the thread rest: it looks at `active`, and lets keyframes pass by."""

    def _on_pose(self, pose: PoseStamped) -> None:
        self._pose = pose
        self._outputs.world = pose.header.frame_id or self._outputs.world

    def _on_poses(self, cloud: PointCloud2) -> None:
        try:
            epoch, correction = read_correction(cloud)
        except DcgsError as error:
            self._warn(f'corrected poses refused: {error}')
            return
        self._queue.submit(lambda: self._correct(correction, epoch))

    def _when_ready(self, work: Callable[[], str]) -> Future[str]:
        return self._queue.submit(work) if self._ready else refused(LOADING.message)

    def _on_reset(self) -> Future[str]:
        done = self._queue.submit(self._reset)
        return done if self._ready else answered(AFTER_RESET)

    def _save(self) -> str:
        return self._session.save(Path(self._params.settings.node.save_folder))

    def _load(self) -> str:
        path = self._params.settings.node.map
        if not path:
            raise DcgsError('node.map names no map')
        text = self._session.load(Path(path))
        self._outputs.keyframes(self._session.mapper)
        self._outputs.update(self._session.mapper)
        return text

    def _autosave(self) -> None:
        """Save the map when that is due and it has changed."""
        settings, mapper = self._params.settings.node, self._session.mapper
        if settings.autosave_s <= 0 or time.monotonic() < self._autosave_s + settings.autosave_s:
            return
        self._autosave_s = time.monotonic()
        if mapper is None or mapper.steps == self._autosaved or not len(mapper.table):
            return
        try:
            self._session.autosave(Path(settings.save_folder))
            self._autosaved = mapper.steps
        except DcgsError as error:
            self._warn(f'map not saved: {error}')

    def _reset(self) -> str:
        text = self._session.reset()
        self._outputs.keyframes(self._session.mapper)
        self._outputs.update(self._session.mapper)
        return text

    def _reconfigure(self, settings: MapperSettings) -> None:
        if not self.configured:
            return
        config = core_config(settings)
        self._queue.submit(lambda: self._session.reconfigure(config))

    def _work(self) -> None:
        """Insert what came, publish what is due, optimise otherwise; until closed."""
        give_way(self._params.settings.node.nice)
        self.get_logger().info(LOADING.message)
        session, outputs = self._session, self._outputs
        warm_up_with_mapper(ANY_CAMERA, self._params.settings)
        self._navigation.warm_up()
        self._ready = True
        self.get_logger().info('ready')
        outputs.keyframes(
            session.mapper
        )  # so that a tracker that runs already sends its keyframes
        busy = False
        while not self._queue.closed:
            parts = self._queue.take(0.0 if busy else _PAUSE_S)
            if not self.active:
                busy = False
                continue
            if parts is not None:
                self._insert(parts)
            outputs.update_when_due(session.mapper)
            if outputs.render_due() and self._pose is not None:
                self._render(self._pose)
            self._autosave()
            busy = self._navigate() or parts is not None or session.advance()

    def _insert(self, parts: dict[str, Any]) -> None:
        """Insert a keyframe, and tell the tracker what became of its Gaussians."""
        try:
            packet = read_keyframe(parts)
        except DcgsError as error:
            self._session.refuse(error)
            return
        update = self._session.insert(packet)
        if update is not None:
            self._outputs.world = parts['pose'].header.frame_id or self._outputs.world
            self._outputs.answer(update, packet.stamp_ns)
        self._outputs.keyframes(self._session.mapper)

    def _navigate(self) -> bool:
        """Bring grid and obstacles up to date; return whether more is to be done at once."""
        session, outputs, T_map_cam = self._session, self._outputs, None
        more = self._navigation.follow(session.mapper, session.camera_frame)
        if self._pose is not None:
            with suppress(DcgsError):  # not a pose: `_render` warns of it
                T_map_cam = matrix(self._pose.pose)
        seen = Seen(outputs.world, outputs.stamp_ns, session.camera_frame, T_map_cam)
        self._navigation.publish_when_due(seen)
        return more

    def _correct(self, correction: Correction, epoch: int) -> None:
        """Move the map; its changes are published when they are due."""
        if self._session.correct(correction, epoch):
            self._navigation.correct()
            self._outputs.keyframes(self._session.mapper)

    def _render(self, pose: PoseStamped) -> None:
        """Publish the map as seen from the tracker's camera."""
        stamp, session = stamp_ns(pose.header.stamp), self._session
        try:
            rendering = session.render(stamp, matrix(pose.pose))
        except DcgsError as error:
            self._warn(f'cannot render: {error}')
            return
        if rendering is not None:
            self._outputs.rendering(rendering, stamp, session.camera_frame)

    def _judged(self) -> tuple[Verdict, dict[str, object]]:
        """Return how mapping goes."""
        if not self.configured:
            return UNCONFIGURED, {}
        verdict = LOADING
        if self._ready:
            verdict = self._session.judge(len(self._queue)) if self.active else INACTIVE
        values = {**self._keyframes.figures(), **self._session.figures()}
        return verdict, values

    def end(self) -> None:
        """End the thread; save the map if that is set."""
        self._queue.close()
        if not self._ready:  # the thread is loading kernels: there is no map
            self._worker.leave()
            return
        self._worker.join()
        if self._params.settings.node.save_on_exit:
            try:
                self.get_logger().info(self._save())
            except DcgsError as error:
                self.get_logger().error(f'map not saved: {error}')
        self._session.close()


def _is_live(key: str) -> bool:
    """Return whether a setting may change while mapping."""
    stage, _, name = key.partition('.')
    return key == 'node.map' or (stage in _LIVE and name not in _FIXED)


def main() -> int:
    """Run the node until it is told to stop."""
    return run(MapperNode)
