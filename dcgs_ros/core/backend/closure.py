# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Loops: keyframes that see a place again, and where they are to each other.

Features say where to look; the pose is that of the tracker's own registration, of the depth of one
keyframe against Gaussians made of the other's and its neighbours' together with the features, and
the other way round. Both must tell the same, and leave no direction open.
"""

from __future__ import annotations

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
from .features import Features, extract
from .neighbourhood import Neighbourhood
from .places import Places, recognition

_TRIED = 3  # keyframes that look most like a new one
_LINKED = 3  # edges of odometry: keyframes so near need no loop
_NEIGHBOURS = 3  # of which the local map of a keyframe is made, besides it
_LEAST_OVERLAP = 0.5  # of the points, in the local map
_MOST_CHI2 = 2.0  # median of the depth factors
_AGREE_M, _AGREE_RAD = 0.02, 0.02  # of both ways, plus their standard deviations
_MOVED_M, _MOVED_RAD = 0.08, 0.06  # by the registration, from where the features say
_SIGMAS = 3.0
_SAME_SHARE = 0.1  # of how far away is what is seen: views that are so little apart show the same


@dataclass(frozen=True)
class Loop:
    """Where keyframe b is, seen from an earlier one that it has no odometry with."""

    a: int
    b: int
    T_a_b: NDArray[np.float64]  # (4, 4)
    covariance: NDArray[np.float64]  # (6, 6) of xi in T_a_b exp(xi), m and rad
    inliers: int  # features that agree


class Closures:
    """Finds the loops of each keyframe with the earlier ones.

    What is kept grows with what there is to see, not with time: a keyframe that shows the same as
    an earlier one is left out once the next one comes.
    """

    def __init__(self, camera: PinholeCamera, config: Config) -> None:
        """Start without keyframes."""
        self._camera = camera
        self._config = config.scaled_to(camera.width, camera.height)
        self.places = Places(camera, config)
        self._clouds: dict[int, FrameCloud] = {}
        self._neighbourhood = Neighbourhood()
        self._seen_again: tuple[int, int] | None = None  # the last keyframe, if one is like it

    def add(
        self,
        keyframe: Keyframe,
        camera: PinholeCamera | None = None,
        features: Features | None = None,
    ) -> None:
        """Keep a keyframe's features, depth and odometry.

        `camera` made its images, if it is another; its `features` are found if they are not known.
        """
        odometry, frame, config = keyframe.odometry, keyframe.frame, self._config
        assert odometry is not None
        self._leave_out()
        camera, moved = camera or self._camera, keyframe.T_cam_cam_at_depth
        cloud = sample(frame, camera, config, config.cloud.stride_px, np.zeros(6))
        k, cloud = odometry.keyframe, cloud.moved(moved)
        self._neighbourhood.add(odometry)
        like = self._neighbourhood.same_view(k, _same_view_m(cloud), among=self._clouds)
        self._seen_again = None if like is None else (k, like)
        self._clouds[k] = cloud
        if features is None:
            features = extract(frame, camera, config.sensor, moved, config.self_mask)
        self.places.add(k, features, is_new=like is None)

    def _leave_out(self) -> None:
        """Leave out the last keyframe, if an earlier one shows the same."""
        if self._seen_again is None:
            return
        keyframe, like = self._seen_again
        self._neighbourhood.leave_out(keyframe, like)
        self.places.forget(keyframe)
        del self._clouds[keyframe]

    def close(self, keyframe: int) -> list[Loop]:
        """Return the loops of a keyframe with earlier ones, which may still be wrong."""
        features = self.places.features_of(keyframe)
        near = self._neighbourhood.around(keyframe, _LINKED)  # itself included
        loops = []
        for candidate in self.places.candidates(features, _TRIED, without=near):
            found = self.places.align(candidate, features)
            if found is not None and found.is_telling(self.places.features_of(candidate)):
                loop = self.verified(candidate, keyframe, found)
                loops += [] if loop is None else [loop]
        return loops

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
        linked = self._neighbourhood.around(keyframe, 1)
        others = sorted(linked.keys() & self._clouds.keys() - {keyframe}, reverse=True)
        return [(k, linked[k]) for k in [keyframe, *others[:_NEIGHBOURS]]]


@dataclass(frozen=True)
class _Registered:
    T_a_b: NDArray[np.float64]  # (4, 4)
    covariance: NDArray[np.float64]  # (6, 6)


def _covariance(uncertainty: PoseUncertainty) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a registration, with the bias that its residuals show."""
    beta2 = BiasVariance().observed(uncertainty.bias_evidence).beta2
    return uncertainty.covariance(beta2, 0.0, np.zeros(6))


def _same_view_m(cloud: FrameCloud) -> float:
    """Return how far apart views show the same, metres."""
    return _SAME_SHARE * float(np.median(cloud.points[:, 2])) if len(cloud) else 0.0
