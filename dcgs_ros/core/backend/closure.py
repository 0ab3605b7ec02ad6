# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Loops: keyframes that see a place again, and where they are to each other.

Features say where to look; the pose is that of the tracker's own registration, of the depth of one
keyframe against Gaussians made of the other's and its neighbours' together with the features, and
the other way round. Both must tell the same, and leave no direction open.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import Config
from ..keyframe import Keyframe
from ..tracking.cloud import FrameCloud
from ..tracking.estimator import sample
from ..tracking.gaussian_map import GaussianMap
from ..tracking.keyframes import spawn
from ..tracking.observability import observability
from ..tracking.propagation import BiasVariance
from ..tracking.registration import DepthTerm, register
from ..tracking.uncertainty import PoseUncertainty, pose_uncertainty
from .alignment import Alignment
from .features import extract
from .places import Places, recognition

_TRIED = 3  # keyframes that look most like a new one
_LINKED = 3  # edges of odometry: keyframes so near need no loop
_NEIGHBOURS = 3  # of which the local map of a keyframe is made, besides it
_LEAST_OVERLAP = 0.5  # of the points, in the local map
_MOST_CHI2 = 2.0  # median of the depth factors
_AGREE_M, _AGREE_RAD = 0.02, 0.02  # of both ways, plus their standard deviations
_MOVED_M, _MOVED_RAD = 0.08, 0.06  # by the registration, from where the features say
_SIGMAS = 3.0


@dataclass(frozen=True)
class Loop:
    """Where keyframe b is, seen from an earlier one that it has no odometry with."""

    a: int
    b: int
    T_a_b: NDArray[np.float64]  # (4, 4)
    covariance: NDArray[np.float64]  # (6, 6) of xi in T_a_b exp(xi), m and rad
    inliers: int  # features that agree


class Closures:
    """Finds the loops of each keyframe with the earlier ones."""

    def __init__(self, camera: PinholeCamera, config: Config) -> None:
        """Start without keyframes."""
        self._camera = camera
        self._config = config.scaled_to(camera.width, camera.height)
        self.places = Places(camera, config)
        self._clouds: dict[int, FrameCloud] = {}
        self._hosts: dict[int, dict[int, NDArray[np.float64]]] = {}  # T_host_cam of a keyframe
        self._links: defaultdict[int, set[int]] = defaultdict(set)  # both ways

    def add(self, keyframe: Keyframe, camera: PinholeCamera | None = None) -> None:
        """Keep a keyframe's features, depth and odometry; `camera` made its images, if another."""
        odometry, frame, config = keyframe.odometry, keyframe.frame, self._config
        assert odometry is not None
        camera, moved = camera or self._camera, keyframe.T_cam_cam_at_depth
        k, hosts = odometry.keyframe, odometry.hosts.tolist()
        self.places.add(k, extract(frame, camera, config.sensor, moved))
        cloud = sample(frame, camera, config, config.cloud.stride_px, np.zeros(6))
        self._clouds[k] = cloud.moved(moved)
        self._hosts[k] = dict(zip(hosts, odometry.T_host_cam, strict=True))
        self._links[k].update(hosts)
        for host in hosts:
            self._links[host].add(k)

    def close(self, keyframe: int) -> list[Loop]:
        """Return the loops of a keyframe with earlier ones, which may still be wrong."""
        features = self.places.features_of(keyframe)
        near = self._linked(keyframe)
        loops = []
        for candidate in self.places.candidates(features, _TRIED, without=near):
            found = self.places.align(candidate, features)
            if found is not None and found.is_telling(self.places.features_of(candidate)):
                loop = self.verified(candidate, keyframe, found)
                loops += [] if loop is None else [loop]
        return loops

    def _linked(self, keyframe: int) -> set[int]:
        """Return the keyframes within a few edges of odometry, itself included."""
        reached = frontier = {keyframe}
        for _ in range(_LINKED):
            frontier = {other for k in frontier for other in self._links[k]} - reached
            reached = reached | frontier
        return reached

    def verified(self, a: int, b: int, found: Alignment) -> Loop | None:
        """Register both ways from where the features say; None unless all agree."""
        forth, back = self._registered(a, b, found), self._registered(b, a, found.inverted())
        if forth is None or back is None:
            return None
        moved = se3.log(se3.inverse(found.T_a_b) @ forth.T_a_b)
        if np.linalg.norm(moved[:3]) > _MOVED_M or np.linalg.norm(moved[3:]) > _MOVED_RAD:
            return None
        apart = se3.log(forth.T_a_b @ back.T_a_b)
        both = np.trace(forth.covariance[:3, :3]) + np.trace(back.covariance[:3, :3])
        turn = np.trace(forth.covariance[3:, 3:]) + np.trace(back.covariance[3:, 3:])
        if np.linalg.norm(apart[:3]) > _AGREE_M + _SIGMAS * np.sqrt(both):
            return None
        if np.linalg.norm(apart[3:]) > _AGREE_RAD + _SIGMAS * np.sqrt(turn):
            return None
        half = se3.exp(-0.5 * apart)  # the mean of both ways
        return Loop(a, b, half @ forth.T_a_b, forth.covariance, found.inliers)

    def _registered(self, a: int, b: int, found: Alignment) -> _Registered | None:
        """Register what b sees against the surroundings of a; None if that is not clear."""
        config, limits, focal = self._config, self._config.registration, self._camera.focal
        depth = DepthTerm(self._clouds[b], self._local_map(a), focal, config)
        then, now = self.places.features_of(a), self.places.features_of(b)
        image = recognition(a, then, now, found).factors(np.eye(4), focal, config.sensor)
        result = register(found.T_a_b, depth, image, config, 2.0 * limits.radius_m)
        result = register(result.T_world_cam, depth, image, config, limits.radius_m)
        if not (result.overlap >= _LEAST_OVERLAP and result.median_chi2 <= _MOST_CHI2):
            return None
        uncertainty = pose_uncertainty(result, self._camera)
        spectrum = observability(result.equations.H, uncertainty.information)
        if spectrum.is_degenerate(limits.degenerate_m, limits.degenerate_rad):
            return None
        return _Registered(result.T_world_cam, _covariance(uncertainty))

    def _local_map(self, keyframe: int) -> GaussianMap:
        """Return Gaussians of a keyframe and of some neighbours, in its camera frame."""
        config = self._config
        gaussians = GaussianMap(2.0 * config.registration.radius_m)
        for number, (k, T) in enumerate(self._surroundings(keyframe)):
            spawn(
                self._clouds[k], T, gaussians, number, self._camera.focal, config.sensor,
                config.keyframes, config.registration.radius_m,
            )  # fmt: skip
        return gaussians

    def _surroundings(self, keyframe: int) -> list[tuple[int, NDArray[np.float64]]]:
        """Return a keyframe and those linked with it, newest first, and T_keyframe_other."""
        found = [(keyframe, np.eye(4))]
        others = sorted(self._links[keyframe].intersection(self._clouds), reverse=True)
        for other in others[:_NEIGHBOURS]:
            T = self._hosts[keyframe].get(other)
            T_keyframe_other = self._hosts[other][keyframe] if T is None else se3.inverse(T)
            found.append((other, T_keyframe_other))
        return found


@dataclass(frozen=True)
class _Registered:
    T_a_b: NDArray[np.float64]  # (4, 4)
    covariance: NDArray[np.float64]  # (6, 6)


def _covariance(uncertainty: PoseUncertainty) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a registration, with the bias that its residuals show."""
    beta2 = BiasVariance().observed(uncertainty.bias_evidence).beta2
    return uncertainty.covariance(beta2, 0.0, np.zeros(6))
