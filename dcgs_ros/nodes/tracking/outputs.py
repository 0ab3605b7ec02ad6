# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Publishes the pose of the base as Odometry, PoseStamped, Path and TF, and records it.

Frames are those of REP 105: the base moves without steps in odom, and is right in map.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from ...core import se3
from ...core.config.nodes import TrackerNodeSettings
from ...core.tracking.result import TrackingState, TrackResult
from ..messages.corrections import write_correction
from ..messages.images import header
from ..messages.odometry import CameraToBase, odometry_message, pose_with_covariance
from ..messages.poses import path, pose_stamped, transform_stamped
from ..transforms import Transforms, make_transforms
from ..transport import RELIABLE, latched
from .corrected import Corrected
from .extrinsics import Mounting
from .map_to_odom import MapToOdom, PlacedBase
from .odometry_frame import OdometryFrame, OdometryPose
from .trajectory_recorder import TrajectoryRecorder

_MAX_GAP_S = 0.5  # between two poses that give a velocity


class TrackerOutputs:
    """Publishes what a tracked frame tells about the base."""

    def __init__(
        self, node: Node, settings: TrackerNodeSettings, warn: Callable[[str], None]
    ) -> None:
        """Advertise the topics; raise `ConfigError` where `base_to_camera` is unusable."""
        self._settings, self._transforms = settings, make_transforms(node)
        self.mounting = Mounting(settings, self._transforms, warn)
        self._recorder = TrajectoryRecorder(settings.save_on_exit)
        self.world = settings.map_frame
        advertise = node.create_publisher
        self._odometry = advertise(Odometry, '~/odometry', RELIABLE)
        self._pose = advertise(PoseStamped, '~/pose', RELIABLE)
        self._with_covariance = advertise(
            PoseWithCovarianceStamped, '~/pose_with_covariance', RELIABLE
        )
        self._camera_pose = advertise(PoseStamped, 'camera_pose', RELIABLE)
        self._keyframe_poses = advertise(PointCloud2, 'keyframe_poses', latched(1))
        self._progress = advertise(Header, '~/progress', RELIABLE)
        self._path = advertise(Path, '~/path', RELIABLE)
        self._path_poses: list[PlacedBase] = []
        self._path_step, self._path_count, self._path_due_s = 1, 0, 0.0
        self._last: TrackResult | None = None
        self._odom = OdometryFrame()
        self._T_map_odom: NDArray[np.float64] | None = None  # None: not known yet
        self._clock = node.get_clock()
        self._beside = self._beside_another(warn)
        if self._beside is not None:
            node.create_timer(settings.tf_delay_s, self._send_map_to_odom)

    def _beside_another(self, warn: Callable[[str], None]) -> MapToOdom | None:
        """Return what places another node's odom in the map; None where there is no such node."""
        settings, transforms = self._settings, self._transforms
        if settings.tf != 'map_to_odom' or not transforms.listens:
            return None
        odom, base = settings.odom_frame, settings.base_frame
        return MapToOdom(
            lambda stamp_ns: transforms.lookup(odom, base, stamp_ns), f'{odom} -> {base}', warn
        )

    @property
    def transforms(self) -> Transforms:
        """TF, for those who ask it for other frames."""
        return self._transforms

    def lookup(self, parent: str, child: str) -> NDArray[np.float64] | None:
        """Return TF's T_parent_child (4, 4), metres; None where it does not know it."""
        return self._transforms.lookup(parent, child)

    @property
    def doubt(self) -> str | None:
        """What is to be done about frames that are not known; None: all are."""
        return self.mounting.doubt or (self._beside.doubt if self._beside is not None else None)

    def publish(self, result: TrackResult, to_base: CameraToBase) -> None:
        """Publish the pose in odom and, unless that is not known, in the map."""
        stamp_ns = result.stamp_ns
        in_odom = self._odom.follow(result, to_base.T_base_cam)
        T_odom_base = to_base.pose(in_odom.T_odom_cam)
        self._publish_odometry(result, in_odom, to_base)
        in_map = header(stamp_ns, self.world)
        self._camera_pose.publish(pose_stamped(result.T_world_cam, in_map))
        if result.submap == 0:
            T_map_base = to_base.pose(result.T_world_cam)
            self._pose.publish(pose_stamped(T_map_base, in_map))
            covariance = to_base.covariance(result.covariance_world, T_map_base)
            self._with_covariance.publish(pose_with_covariance(in_map, T_map_base, covariance))
            keyframe = -1 if result.reference is None else result.reference.keyframe
            placed = PlacedBase(stamp_ns, T_map_base, keyframe)
            self._T_map_odom = T_map_base @ se3.inverse(T_odom_base)
            if self._beside is not None:
                self._beside.place(placed, self._clock.now().nanoseconds)
            self._extend_path(placed, in_map)
            self._recorder.add(stamp_ns, T_map_base)
        if self._settings.tf == 'odom_to_base':
            self._send_transforms(T_odom_base, stamp_ns)
        self._last = result

    def _publish_odometry(
        self, result: TrackResult, in_odom: OdometryPose, to_base: CameraToBase
    ) -> None:
        """Publish the pose in odom with its drift, and the velocity since the last one.

        Also where another node's odometry is odom: fused there, ours must not step.
        """
        T_odom_base = to_base.pose(in_odom.T_odom_cam)
        covariance = to_base.covariance(in_odom.covariance, T_odom_base)
        twist, twist_covariance = to_base.twist(*self._camera_twist(result))
        message = odometry_message(
            header(result.stamp_ns, self._settings.odom_frame), self._settings.base_frame,
            T_odom_base, covariance, twist, twist_covariance,
        )  # fmt: skip
        self._odometry.publish(message)

    def lose(self) -> None:
        """Take note that the camera is lost."""
        self._odom.lose()

    def correct(self, corrected: Corrected, epoch: int) -> None:
        """Move what was published of the map `epoch`, and tell the mapper."""
        self._odom.correct(corrected)
        if self._last is not None:
            T_world_cam = corrected.here @ self._last.T_world_cam
            self._last = replace(self._last, T_world_cam=T_world_cam)
        self._path_poses = [pose.moved(corrected.motions) for pose in self._path_poses]
        if self._beside is not None:
            self._beside.correct(corrected.motions)
        if len(corrected.named.stamps_ns):
            self._keyframe_poses.publish(write_correction(corrected.named, epoch, self.world))

    def progress(self, header: Header) -> None:
        """Tell a replay which frame is done, whatever came of it."""
        if self._progress.get_subscription_count():
            self._progress.publish(header)

    def forget(self) -> None:
        """Begin a new path, and odom where the base is then."""
        self._path_poses.clear()
        self._path_step, self._last = 1, None
        self._odom, self._T_map_odom = OdometryFrame(), None
        if self._beside is not None:
            self._beside.forget()

    def remount(self, assumed: NDArray[np.float64], T_base_cam: NDArray[np.float64]) -> None:
        """Correct where the camera is on the base (4, 4); the path begins anew."""
        self.forget()
        self._recorder.remount(assumed, T_base_cam)

    def close(self) -> str | None:
        """Write the recorded trajectory; return what was written, if anything."""
        return self._recorder.write()

    def _camera_twist(
        self, result: TrackResult
    ) -> tuple[NDArray[np.float64], NDArray[np.floating]]:
        """Return the camera's twist (6,) since the last pose, per second, and covariance (6, 6).

        The covariance is that of the motion between the two: along what neither holds, the motion
        model knows it better than either pose. Without a recent pose, or where the camera was only
        found again, it is unknown: zero, with a covariance of a metre and a radian.
        """
        last, covariance = self._last, result.motion_covariance
        if last is None or covariance is None or result.state is TrackingState.RELOCALISED:
            return np.zeros(6), np.eye(6)
        dt = (result.stamp_ns - last.stamp_ns) * 1e-9
        if not 0 < dt < _MAX_GAP_S:
            return np.zeros(6), np.eye(6)
        motion = se3.inverse(last.T_world_cam) @ result.T_world_cam
        return se3.log(motion) / dt, covariance / dt**2

    def _send_transforms(self, T_odom_base: NDArray[np.float64], stamp_ns: int) -> None:
        """Broadcast; odom stays where it was in the map while the place there is not known."""
        settings = self._settings
        in_odom = header(stamp_ns, settings.odom_frame)
        self._transforms.send(transform_stamped(T_odom_base, in_odom, settings.base_frame))
        if self._T_map_odom is not None:
            in_map = header(stamp_ns, self.world)
            self._transforms.send(transform_stamped(self._T_map_odom, in_map, settings.odom_frame))

    def _send_map_to_odom(self) -> None:
        """Broadcast where the other node's odom is in the map."""
        assert self._beside is not None
        settings, now_ns = self._settings, self._clock.now().nanoseconds
        found = self._beside.at(now_ns, int(1e9 * settings.tf_tolerance_s))
        if found is not None:
            in_map = header(found.stamp_ns, self.world)
            self._transforms.send(transform_stamped(found.T_map_odom, in_map, settings.odom_frame))

    def _extend_path(self, pose: PlacedBase, in_map: Header) -> None:
        """Add every pose; once the path is full every second one, then every fourth, and so on."""
        self._path_count += 1
        if self._path_count % self._path_step == 0:
            self._path_poses.append(pose)
        if len(self._path_poses) > self._settings.path_poses:
            self._path_poses = self._path_poses[::2]
            self._path_step *= 2
        now, rate_hz = time.monotonic(), self._settings.path_rate_hz
        if rate_hz > 0 and now >= self._path_due_s and self._path.get_subscription_count():
            self._path_due_s = now + 1.0 / rate_hz
            poses = [
                pose_stamped(p.T_map_base, header(p.stamp_ns, self.world))
                for p in self._path_poses
            ]
            self._path.publish(path(poses, in_map))
