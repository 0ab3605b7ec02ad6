# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The map that a tracker makes: Gaussians, the keyframes that host them, and new landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import Config
from ..keyframe import Correction, Keyframe, Odometry
from .claims import Claim
from .corners import spread
from .depth_bias import DepthBias
from .estimator import Estimate, Memory, RegisteredFrame
from .gaussian_map import GaussianMap
from .hosting import Hosts, hosts_of
from .keyframes import KeyframePolicy, candidates, spawn
from .landmarks import Landmarks, detect
from .newcomers import Newcomers
from .uncertainty import PoseUncertainty
from .visited import Visited


class GrowingMap:
    """Grows at keyframes, and moves with them."""

    def __init__(self, camera: PinholeCamera, config: Config) -> None:
        """Start empty; `config` is scaled to the camera."""
        self._camera, self._config = camera, config
        self._policy = KeyframePolicy(config.keyframes)
        self._next_landmark = 0  # id
        self._newcomers = Newcomers(camera)
        self.visited = Visited()  # the keyframes
        self.host = 0  # the keyframe that the camera is placed relative to
        self.depth_bias = DepthBias(camera, config.sensor.depth_bias)
        self.begin()

    def begin(self) -> None:
        """Forget all Gaussians and keyframes."""
        self.gaussians = GaussianMap(2.0 * self._config.registration.radius_m)
        self.visited.reset()
        self.depth_bias.reset(())

    def resume(
        self,
        gaussians: GaussianMap,
        poses: Sequence[NDArray[np.float64]],
        stamps_ns: Sequence[int],
        submaps: Sequence[int],
        odometries: Sequence[Odometry | None],
    ) -> None:
        """Go on with Gaussians and keyframes, see `Visited.reset`."""
        self.gaussians = gaussians
        self.visited.reset(stamps_ns, poses, submaps, odometries)
        self.depth_bias.reset(poses)

    def reconfigure(self, config: Config) -> None:
        """Grow by other settings."""
        self._config = config
        self._policy.config = config.keyframes

    def correct(self, correction: Correction) -> NDArray[np.float64]:
        """Move it to better poses of its keyframes; return their motions (K, 4, 4)."""
        motions = self.visited.correct(correction)
        self.gaussians.move(motions)
        self.depth_bias.move(self.visited.poses)
        self._policy.move(motions[self.host])
        self._newcomers.move(motions[self.host])
        return motions

    @property
    def submap(self) -> int:
        """That in which the camera is placed."""
        return self.visited.submaps[self.host]

    def claim(
        self, found: Estimate, uncertainty: PoseUncertainty, covariance: NDArray[np.float64]
    ) -> Claim:
        """Return how sure a registered pose is that has the `covariance` (6, 6) in the map."""
        T, reach_m = found.registered.T_world_cam, self._config.registration.guess_radius_m
        hosts = hosts_of(found.registration, uncertainty.rows, covariance, self.host)
        hosts = self.visited.within_reach(T, hosts, self.host, reach_m)
        in_world = self.visited.in_world(T, hosts)
        return Claim(covariance, in_world, hosts, self.submap)

    def in_world(
        self, T_world_cam: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the covariance (6, 6) in the world of a pose (4, 4) that only the host holds."""
        return self.visited.in_world(T_world_cam, Hosts.only(self.host, covariance))

    def observe(self, registered: RegisteredFrame, keep: bool) -> None:
        """Look for what is gone in a tracked frame, and remove it, unless the map is to `keep` it.

        Gaussians of keyframes before those that the last one fits are left: there it may be the
        map that is wrong.
        """
        due = self._newcomers.observe(registered, self.gaussians, self._config.sensor)
        odometry = self.visited.odometries[-1]
        if due and odometry is not None and not keep:
            first = int(odometry.hosts.min(initial=odometry.keyframe))
            self.gaussians.remove_gone(first)

    def wants_keyframe(self, found: Estimate, memory: Memory) -> bool:
        """Return whether a frame should become a keyframe; `memory` is that after it."""
        return self._policy.wants(
            found.registered.T_world_cam, found.registered.frame.stamp_ns,
            float(np.linalg.norm(memory.motion.twist[3:])), found.registration.overlap,
            len(memory.landmarks),
        )  # fmt: skip

    def goes_on_at(self, registered: RegisteredFrame, landmarks: int) -> None:
        """Take a frame for the last keyframe, which it was found near."""
        self._policy.took(registered.T_world_cam, registered.frame.stamp_ns, landmarks)

    def extend(
        self,
        registered: RegisteredFrame,
        last: RegisteredFrame | None,
        claim: Claim,
        memory: Memory,
    ) -> tuple[Keyframe, Memory, float]:
        """Refresh Sigma_t of the Gaussians in view, spawn new ones, anchor new landmarks.

        Points spawn only where the `last` frame's depth, if there is one, confirms them. Return
        the keyframe, the memory with its landmarks, and how well the frame agreed with the map.
        """
        config, frame, T = self._config, registered.frame, registered.T_world_cam
        odometry = self.visited.odometry(T, claim.submap, claim.covariance, claim.hosts)
        keyframe = self.host = odometry.keyframe
        T_world_depth = T @ registered.T_cam_cam_at_depth
        agreement = self.gaussians.refresh(
            T_world_depth, frame.depth_m, self._camera, config.sensor, keyframe
        )
        cloud = candidates(registered, last, self._camera, config)
        points = se3.transform(T_world_depth, cloud.points)
        cloud = cloud[~self._newcomers.among(points, config.sensor)]
        ids = spawn(
            cloud.moved(registered.T_cam_cam_at_depth), T, self.gaussians, keyframe,
            self._camera.focal, config.sensor, config.keyframes, config.registration.radius_m,
        )  # fmt: skip
        memory = self.with_landmarks(memory, registered, keyframe)
        self.goes_on_at(registered, len(memory.landmarks))
        self.visited.add(frame.stamp_ns, T, odometry, claim.in_world)
        self.depth_bias.add_keyframe(T)
        means, normals = self.gaussians.of(ids)
        sightings = memory.landmarks.sighted(
            frame.depth_m, T, registered.T_cam_cam_at_depth, registered.twist, self._camera,
            config.sensor,
        )  # fmt: skip
        made = Keyframe(
            frame, T, registered.T_cam_cam_at_depth, ids, means, normals, odometry, sightings,
            claim.submap,
        )  # fmt: skip
        return made, memory, agreement

    def lacks_landmarks(self, memory: Memory) -> bool:
        """Return whether they are few, or missing where there were some, since the detection."""
        spread_then, share = memory.spread, self._config.landmarks.replenish
        if spread_then is None:
            return False
        left = self._spread(memory.landmarks)
        if len(memory.landmarks) < share * spread_then.sum():
            return True
        return bool(np.any(left < 0.5 * spread_then - 1.0))

    def with_landmarks(
        self, memory: Memory, registered: RegisteredFrame, host: int = -1
    ) -> Memory:
        """Return the memory with landmarks detected anew; `host` is the frame's keyframe."""
        if not self._config.uses_landmarks:
            return memory
        new = detect(
            registered.grey, registered.frame.depth_m, memory.landmarks, registered.T_world_cam,
            registered.T_cam_cam_at_depth, registered.twist, self.gaussians, self._camera,
            self._config.sensor, self._config.landmarks, self._config.registration.anchor_px, host,
        )  # fmt: skip
        new = new[~self._newcomers.among(new.targets.points, self._config.sensor)]
        new = replace(new, ids=self._next_landmark + np.arange(len(new)))
        self._next_landmark += len(new)
        landmarks = memory.landmarks.joined(new)
        return replace(memory, landmarks=landmarks, spread=self._spread(landmarks))

    def _spread(self, landmarks: Landmarks) -> NDArray[np.int64]:
        return spread(landmarks.pixels, (self._camera.height, self._camera.width))

    def relative_to_host(self, T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a pose (4, 4) in the frame of the keyframe that the camera is placed by."""
        return se3.inverse(self.visited.poses[self.host]) @ T_world_cam
