# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The tracker node: RGB-D images in, odometry and keyframes out.

The executor's thread receives and pairs images, a second thread tracks, a third sends keyframes.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

import numpy as np

from ..core.config.nodes import TrackerSettings, core_config
from ..core.config.presets import ONLINE
from ..core.config.schema import override
from ..core.errors import DcgsError
from ..core.keyframe import Correction, MapUpdate
from ..core.tracking.result import TrackingState
from ..core.tracking.warmup import ANY_CAMERA, warm_up
from .health import LOADING, PAUSED, Verdict
from .lifetime import Worker, run
from .managed import INACTIVE, UNCONFIGURED, ManagedNode
from .parameters import Parameters
from .reporter import Reporter
from .services import answered, offer, refused
from .tracking.back_end import make_loops, warm_up_loops
from .tracking.camera_subscriber import CameraSubscriber
from .tracking.frame_info import FrameInfo
from .tracking.frame_rate import FrameRate
from .tracking.frame_reader import SomeImage
from .tracking.health import judge
from .tracking.initial_pose import InitialPose
from .tracking.keyframe_publisher import KeyframePublisher
from .tracking.keyframe_sender import KeyframeSender
from .tracking.known_map import KnownMap, preferred, save
from .tracking.live_points import LivePoints
from .tracking.mapper_subscriber import MapperSubscriber
from .tracking.outputs import TrackerOutputs
from .tracking.pairing import ImagePair
from .tracking.robot_sensors import RobotSensors
from .tracking.session import AFTER_RESET, TrackingSession

_FIXED = (
    'sensor',
    'timing',
    'ablation',
    'shared_klt_weight',
    'threads',
    'priors',
    'backend',
    'node',
)


class TrackerNode(ManagedNode):
    """Odometry from an RGB-D camera."""

    def __init__(self) -> None:
        """Begin at once, unless another node is to say when."""
        super().__init__('dcgs_tracker')
        self._reporter = Reporter(self, 'tracking', self._judged)
        self._warn = self._reporter.warn
        defaults = override(TrackerSettings(), ONLINE)
        self._params = Parameters(self, defaults, _is_live, self._reconfigure)
        if self._params.settings.node.autostart:
            self.autostart()

    def configure(self) -> None:
        """Subscribe, and start the threads; images are subscribed to once it is active."""
        settings = self._params.settings
        node_settings = settings.node
        self._outputs = TrackerOutputs(self, node_settings, self._warn)
        self._points = LivePoints(self, node_settings.points_rate_hz)
        self._camera = CameraSubscriber(
            self, node_settings, self._warn, self._outputs.lookup, self._reporter.inform
        )
        self._sensors = RobotSensors(self, settings, self._outputs.transforms, self._warn)
        localizes = node_settings.mode == 'localization'
        self._known = KnownMap.read(Path(node_settings.map)) if node_settings.map else None
        if localizes and self._known is None:
            raise DcgsError('node.mode is localization, but node.map names no map')
        self._loops = make_loops(settings, self._on_correction, self._warn)
        self._session = TrackingSession(
            core_config(settings), np.eye(4), self._warn, self._loops, localizes,
            self._sensors.priors,
        )  # fmt: skip
        publisher = KeyframePublisher(self, self._outputs.world)
        memory_mb = node_settings.keyframe_memory_mb
        self._sender = KeyframeSender(publisher, memory_mb, self._session.alive)
        self._frame_info = FrameInfo(self)
        self._initial_pose = InitialPose(self, node_settings.map_frame, self._warn)
        self._mapper = MapperSubscriber(
            self, self._on_answer, self._sender.acknowledge, self._warn
        )
        offer(self, '~/reset', self._on_reset)
        offer(self, '~/pause', self._on_pause)
        offer(self, '~/resume', self._on_resume)
        offer(self, '~/save_map', lambda: self._when_ready(self._save))
        offer(self, '~/load_map', lambda: self._when_ready(self._load))
        self._rate = FrameRate(node_settings.max_rate_hz)
        self._camera.pause()
        self._worker = Worker(self, self._work, 'tracking')

    def activate(self) -> None:
        """Subscribe to the images."""
        self._camera.resume()

    def deactivate(self) -> None:
        """Subscribe to no images."""
        self._camera.pause()

    def _on_answer(self, update: MapUpdate, epoch: int) -> None:
        self._camera.queue.submit(lambda: self._session.apply(update, epoch))

    def _on_correction(self, correction: Correction, epoch: int) -> None:
        self._camera.queue.submit(lambda: self._correct(correction, epoch))

    def _correct(self, correction: Correction, epoch: int) -> None:
        """Move the map between two frames, and tell the mapper."""
        corrected = self._session.correct(correction, epoch)
        if corrected is not None:
            self._outputs.correct(corrected, epoch)
            self._sender.correct(corrected.named)

    def _on_reset(self) -> Future[str]:
        done = self._camera.queue.submit(self._reset)
        return done if self._ready else answered(AFTER_RESET)

    def _reset(self) -> str:
        text = self._session.reset()
        self._sender.forget()
        self._outputs.forget()
        return text

    def _on_pause(self) -> Future[str]:
        self._camera.pause()
        return answered(PAUSED.message)

    def _on_resume(self) -> Future[str]:
        if not self.active:
            return refused(INACTIVE.message)
        self._camera.resume()
        return answered('tracking goes on with the next image')

    def _when_ready(self, work: Callable[[], str]) -> Future[str]:
        return self._camera.queue.submit(work) if self._ready else refused(LOADING.message)

    def _save(self) -> str:
        known = self._session.known
        before = known.sessions if isinstance(known, KnownMap) else ()
        folder = Path(self._params.settings.node.save_folder)
        return save(self._session.tracker, folder, before)

    def _load(self) -> str:
        path = self._params.settings.node.map
        if not path:
            raise DcgsError('node.map names no map')
        known = KnownMap.read(Path(path))
        self._session.load(known)
        self._sender.forget()
        self._outputs.forget()
        return f'{known} in {path}: the camera is looked for in it'

    def _reconfigure(self, settings: TrackerSettings) -> None:
        if not self.configured:
            return
        config = core_config(settings)
        self._camera.queue.submit(lambda: self._session.reconfigure(config))

    def _work(self) -> None:
        """Load the kernels, then track every pair until closed."""
        self.get_logger().info(LOADING.message)
        warm_up(ANY_CAMERA, self._params.settings)
        warm_up_loops(self._params.settings)
        self._camera.warm_up()
        self._resume()
        self._camera.begin()
        self._ready = True
        self.get_logger().info('ready')
        queue = self._camera.queue
        while not queue.closed:
            pair = queue.take(0.2)
            if pair is None:
                continue
            try:
                if self._camera.reader.has_camera and self._rate.admits(pair.color_ns):
                    self._track(pair)
            except DcgsError as error:
                self._session.refuse(error)
            self._outputs.progress(pair.color.header)

    def _resume(self) -> None:
        """Go on in the map of a mapper, if that is set and there is one, or of a file."""
        settings = self._params.settings.node
        maps = settings.resume and settings.mode == 'mapping'
        found = self._mapper.resumable(settings.resume_wait_s) if maps else None
        chosen, self._known = preferred(found, self._known), None
        if chosen is not None:
            self._session.resume(chosen)
            self.get_logger().info(f'going on in a map of {chosen}')

    def _track(self, pair: ImagePair[SomeImage, SomeImage]) -> None:
        """Track a frame; publish its pose, then what the mapper should get."""
        per_metre = self._params.settings.node.depth_per_metre
        frame, camera = self._camera.reader.read(pair, per_metre)
        camera_frame = pair.color.header.frame_id
        session, to_base = self._session, self._outputs.mounting.find(camera_frame)
        if to_base is None:
            session.counts['waiting_for_tf'] += 1
            return
        epoch = session.epoch
        if to_base.T_base_cam is not session.T_world_first:
            self._outputs.remount(session.T_world_first, to_base.T_base_cam)
            session.remount(to_base.T_base_cam, frame)
        place = self._initial_pose.take(to_base)
        if place is not None:
            session.expect(place)
        self._sensors.sense(frame.stamp_ns, camera_frame)
        result = session.track(frame, camera)
        if result is None:
            return
        self._frame_info.publish(result, session.ms, self._sensors.reasons)
        if session.epoch != epoch:
            self._sender.forget()
        if result.state is not TrackingState.LOST:
            self._outputs.publish(result, to_base)
            assert session.tracker is not None
            self._points.publish(frame, result, session.tracker, camera_frame)
        elif session.searching:
            self._outputs.lose()
        for packet in session.packets(frame, result, camera_frame):
            self._sender.put(packet)

    def _judged(self) -> tuple[Verdict, dict[str, object]]:
        """Return how tracking goes."""
        if not self.configured:
            return UNCONFIGURED, {}
        session, news = self._session, self._camera.news()
        priors = self._sensors.reasons()
        verdict = (PAUSED if self.active else INACTIVE) if self._ready else LOADING
        if self._ready and not self._camera.paused:
            missed = self._camera.missed_text()
            if missed is not None:
                self._warn(missed)
            verdict = judge(
                news, session.result, session.searching, ever_tracked=session.ever_tracked,
                refusal=session.refusal, doubt=self._outputs.doubt, priors=priors,
            )  # fmt: skip
        values = {
            'ms': session.ms, **self._camera.figures(), 'left_out': self._rate.left_out,
            **session.counts, **self._sender.figures(), **session.figures(),
            **self._loops.figures(), **{f'prior_{name}': why for name, why in priors.items()},
        }  # fmt: skip
        return verdict, values

    def end(self) -> None:
        """End the threads; write the trajectory if that is set."""
        self._camera.queue.close()
        if self._ready:
            self._worker.join()
        else:  # it is loading kernels
            self._worker.leave()
        self._sender.close()
        self._loops.close()
        written = self._outputs.close()
        if written is not None:
            self.get_logger().info(written)


def _is_live(key: str) -> bool:
    """Return whether a setting may change while tracking."""
    return key == 'node.map' or key.split('.')[0] not in _FIXED


def main() -> int:
    """Run the node until it is told to stop."""
    return run(TrackerNode)
