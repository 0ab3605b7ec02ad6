# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How often and for how long a tracker was in each of its states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.tracking.result import TrackingState


@dataclass(frozen=True)
class Stretch:
    """Consecutive frames in one state."""

    state: TrackingState
    frames: int
    start_ns: int  # stamp of the first
    end_ns: int  # stamp of the frame after them; of the last one if there is none

    @property
    def seconds(self) -> float:
        """How long the state lasted."""
        return (self.end_ns - self.start_ns) * 1e-9


def stretches(stamps_ns: NDArray[np.int64], states: Sequence[TrackingState]) -> list[Stretch]:
    """Divide N frames, `stamps_ns` (N,), into the longest stretches of one state, in order."""
    if not states:
        return []
    changes = [k for k in range(1, len(states)) if states[k] is not states[k - 1]]
    starts, ends = [0, *changes], [*changes, len(states)]
    return [
        Stretch(states[i], j - i, int(stamps_ns[i]), int(stamps_ns[min(j, len(states) - 1)]))
        for i, j in zip(starts, ends, strict=True)
    ]


def states_report(
    stamps_ns: NDArray[np.int64], states: Sequence[TrackingState]
) -> dict[str, dict[str, float]]:
    """Return the part `states` of a report: number of frames and longest stretch of each state."""
    found = stretches(stamps_ns, states)
    return {
        state.value: {
            'frames': sum(s.frames for s in found if s.state is state),
            'longest_s': max((s.seconds for s in found if s.state is state), default=0.0),
        }
        for state in TrackingState
    }
