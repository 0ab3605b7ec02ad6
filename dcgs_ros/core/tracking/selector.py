# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which frames the mapper gets to see."""

from __future__ import annotations

from .. import se3
from ..frame import RgbdFrame
from ..keyframe import KeyframePose, PosedFrame
from .result import TrackingState, TrackResult

_SURE = (TrackingState.OK, TrackingState.DEGENERATE)  # a pose is known, not only supposed


class KeyframeSelector:
    """Selects the tracker's keyframes, and every `interval`-th frame between them as a view.

    Of a lost camera, one whose relocalisation is not confirmed yet, or one that only other sensors
    carry, no frame is a view.
    """

    def __init__(self, interval: int) -> None:
        """Count frames from the first on; `interval` may change at any time."""
        self.interval = interval
        self._since = 0  # frames since the last one that was selected

    def select(self, frame: RgbdFrame, result: TrackResult) -> list[PosedFrame]:
        """Return what the mapper should get now that this frame is tracked, oldest first."""
        selected: list[PosedFrame] = list(result.keyframes)
        if result.state in _SURE and not result.carried:
            self._since += 1
            if not result.keyframe and self._since >= self.interval:
                view = PosedFrame(
                    frame, result.T_world_cam, result.T_cam_cam_at_depth,
                    reference=_reference(result),
                )  # fmt: skip
                selected.append(view)
        if selected or result.keyframe:
            self._since = 0
        return selected


def _reference(result: TrackResult) -> KeyframePose | None:
    """Return the keyframe that a frame was placed relative to, and where that is."""
    reference = result.reference
    if reference is None:
        return None
    T = result.T_world_cam @ se3.inverse(reference.T_keyframe_cam)
    return KeyframePose(reference.stamp_ns, T)
