# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The pose corrections and exposures of the mapper's views, interpolated to other frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .. import se3
from .exposure import Exposure


class Corrections:
    """Pose corrections and exposures of at least one view, interpolated in time.

    A correction C is on the right, T_world_cam = T_tracked C: a motion in the camera's own frame.
    """

    def __init__(
        self,
        stamps_ns: NDArray[np.int64],  # (K,) rising
        T_tracked: NDArray[np.float64],  # (K, 4, 4) T_world_cam of the tracker
        T_world_cam: NDArray[np.float64],  # (K, 4, 4) as the mapper refined it
        exposures: Sequence[Exposure],  # K
    ) -> None:
        """Compute the logarithms of the corrections."""
        self._first_ns = int(stamps_ns[0])
        self._times = (stamps_ns - self._first_ns).astype(np.float64)
        pairs = zip(T_tracked, T_world_cam, strict=True)
        self._logs = np.array([se3.log(se3.inverse(a) @ b) for a, b in pairs])
        self._gains = np.array([exposure.gain for exposure in exposures])
        self._offsets = np.array([exposure.offset for exposure in exposures])

    def pose(self, stamp_ns: int, T_tracked: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (4, 4) the pose in the mapper's world of a frame tracked at `T_tracked`.

        Before the first and after the last view, their correction is used.
        """
        return T_tracked @ se3.exp(self._at(stamp_ns, self._logs))

    def exposure(self, stamp_ns: int) -> Exposure:
        """Return the exposure at an instant."""
        gain, offset = (self._at(stamp_ns, values) for values in (self._gains, self._offsets))
        return Exposure(gain.astype(np.float32), offset.astype(np.float32))

    def _at(self, stamp_ns: int, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return (D,) each column of `values` (K, D) at an instant."""
        time = float(stamp_ns - self._first_ns)
        return np.array([np.interp(time, self._times, column) for column in values.T])
