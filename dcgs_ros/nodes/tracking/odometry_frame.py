# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The camera in odom, the frame in which it moves without steps (REP 105); no ROS in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.tracking.result import TrackingState, TrackResult
from .corrected import Corrected

_UNKNOWN = np.eye(6)  # 1 m, 1 rad: how far a camera goes while it is not tracked


@dataclass(frozen=True)
class OdometryPose:
    """Where the camera is in odom."""

    T_odom_cam: NDArray[np.float64]  # (4, 4)
    covariance: NDArray[np.float64]  # (6, 6) of xi in T_odom_cam exp(xi): the drift since it began


class OdometryFrame:
    """Adds up the camera's motion from frame to frame, as it was tracked.

    Corrections of the map do not count. Where the camera was lost its motion is not known, and it
    goes on from where it was last, with a metre and a radian more of drift. Drift adds up over
    keyframes, since the frames between two of them are tracked against the same map.
    """

    def __init__(self) -> None:
        """Begin with the next frame."""
        self._T_odom_cam = np.eye(4)
        self._drift = np.zeros((6, 6))  # of eps in exp(eps) T_odom_keyframe, of the newest one
        self._last: TrackResult | None = None
        self._broken = False  # the camera was lost since the last frame

    def lose(self) -> None:
        """Take note that the camera is lost."""
        self._broken = True

    def correct(self, corrected: Corrected) -> None:
        """Take note that the world of the next frames is a corrected one."""
        last = self._last
        if last is None:
            return
        reference = last.reference
        if reference is not None:
            submap = int(corrected.applied.submaps[reference.keyframe])
            reference = replace(reference, submap=submap)
        moved = corrected.here @ last.T_world_cam
        self._last = replace(last, T_world_cam=moved, reference=reference)

    def follow(self, result: TrackResult, T_base_cam: NDArray[np.float64]) -> OdometryPose:
        """Return where a tracked frame is.

        odom begins where the map has its world, if the first frame is in the map, else at the
        base, on which the camera is at `T_base_cam` (4, 4).
        """
        last, T = self._last, self._T_odom_cam
        if last is None:
            T = result.T_world_cam if result.submap == 0 else T_base_cam
        elif self._is_connected(last, result):
            T = T @ se3.inverse(last.T_world_cam) @ result.T_world_cam
        else:
            self._drift = self._drift + _in_world(_UNKNOWN, T)
        self._T_odom_cam = T = se3.orthonormalised(T)
        covariance = _in_world(self._drift, se3.inverse(T)) + result.covariance
        if result.keyframe:
            self._drift = self._drift + _in_world(result.covariance, T)
        self._last, self._broken = result, False
        return OdometryPose(T, covariance)

    def _is_connected(self, last: TrackResult, result: TrackResult) -> bool:
        """Return whether the motion between two frames was tracked."""
        found = TrackingState.RELOCALISED
        found_again = result.state is found and last.state is not found
        return not (self._broken or found_again or last.submap != result.submap)


def _in_world(covariance: NDArray[np.floating], T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of eps in exp(eps) T for that of xi in T exp(xi)."""
    Ad = se3.adjoint(T)
    return Ad @ covariance @ Ad.T
