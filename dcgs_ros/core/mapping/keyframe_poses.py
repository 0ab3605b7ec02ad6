# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Where the tracker's keyframes are, by their names, and what a correction moves with them.

Frames come to the mapper late, in any order, and from before or after a correction. Each tells
which keyframe it was placed relative to and where that was then, so that it can be put where the
keyframe is now.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..keyframe import Correction, Keyframe, KeyframePose, PosedFrame

_SAME = 1e-6  # metres and radians: less is the rounding of messages and products


@dataclass(frozen=True)
class Moves:
    """What a correction does to the keyframes that were known; the last row is for all others."""

    stamps_ns: NDArray[np.int64]  # (K,) rising
    motions: NDArray[np.float64]  # (K + 1, 4, 4) from where the world had each to where it is now
    moved: NDArray[np.bool_]  # (K + 1,) which of them are not the identity

    def row(self, reference_ns: int | None, stamp_ns: int) -> int:
        """Return the row of the keyframe that a view goes with.

        It is that of its reference or, where that is not known, of the latest keyframe at or
        before the view.
        """
        known = stamp_ns if reference_ns is None else reference_ns
        return int(np.searchsorted(self.stamps_ns, known, side='right')) - 1


class KeyframePoses:
    """T_world_cam of the keyframes by their stamps, as received or corrected last."""

    def __init__(self) -> None:
        """Start without keyframes."""
        self._poses: dict[int, NDArray[np.float64]] = {}
        self._submaps: dict[int, int] = {}

    def reference(self, posed: PosedFrame) -> KeyframePose | None:
        """Return the keyframe that a frame goes with, itself if it is one; None if not known."""
        if posed.reference is None and isinstance(posed, Keyframe):
            return KeyframePose(posed.frame.stamp_ns, posed.T_world_cam)
        return posed.reference

    def made_in(self, stamp_ns: int, submap: int) -> None:
        """Take note of the sub-map of a keyframe; where a correction has told, that counts."""
        self._submaps.setdefault(stamp_ns, submap)

    def submaps(self, names_ns: Sequence[int]) -> list[int]:
        """Return the sub-map of each keyframe; of an unknown one, that of the one before."""
        found, newest = [], 0
        for name in names_ns:
            newest = self._submaps.get(name, newest)
            found.append(newest)
        return found

    def motion_since(self, then: KeyframePose) -> NDArray[np.float64]:
        """Return the motion (4, 4), in the world, of a keyframe to where it is now.

        One that is not known yet is where it was then.
        """
        now = self._poses.setdefault(then.stamp_ns, then.T_world_cam)
        return _motions(then.T_world_cam[None], now[None])[0]

    def correct(self, correction: Correction, others_stay: bool) -> Moves:
        """Take corrected poses; return how the keyframes that were known move.

        Those that the correction does not name move with the latest named one before them, unless
        they stay.
        """
        stamps = np.array(sorted(self._poses), np.int64)
        before = np.reshape([self._poses[stamp] for stamp in stamps.tolist()], (-1, 4, 4))
        corrected = zip(correction.stamps_ns.tolist(), correction.T_world_cam, strict=True)
        self._poses.update(corrected)
        submaps = correction.submaps.tolist()
        self._submaps.update(zip(correction.stamps_ns.tolist(), submaps, strict=True))
        after = np.reshape([self._poses[stamp] for stamp in stamps.tolist()], (-1, 4, 4))
        motions = np.concatenate([_motions(before, after), np.eye(4)[None]])
        named = np.isin(stamps, correction.stamps_ns)
        rows = np.where(named, np.arange(len(stamps)), -1)
        if not others_stay:
            rows = np.maximum.accumulate(rows)
        motions[:-1] = motions[rows]
        for k in np.flatnonzero(~named & (rows >= 0)):
            self._poses[int(stamps[k])] = motions[k] @ before[k]
        return Moves(stamps, motions, (motions != np.eye(4)).any(axis=(1, 2)))


def _motions(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the motions (K, 4, 4) between poses (K, 4, 4), exactly the identity where none is."""
    motions = after @ se3.inverse(before)
    same = np.abs(after - before).max(axis=(1, 2), initial=0.0) < _SAME
    motions[same] = np.eye(4)
    return motions
