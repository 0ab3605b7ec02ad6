# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Whether a sensor agrees with the images, where those are sure, and what its errors then are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_CONTRADICTION = 16.0  # chi2 of three numbers: one in a thousand is beyond by chance
_GROSS = 100.0  # beyond it once is enough
_STRIKES = 2  # contradictions, less agreements, that leave a sensor out
_PROOFS = 6  # agreements in a row that take it back


class InnovationMonitor:
    """Counts how often a sensor contradicts what the images tell of the same interval."""

    def __init__(self) -> None:
        """Trust the sensor until it contradicts."""
        self.reason: str | None = None  # why it is left out
        self._strikes = 0
        self._proofs = 0

    def agrees(self, chi2: float, what: str) -> bool:
        """Take one interval's chi2, of three numbers; return whether it may be learned from.

        `what` says in words by how much the sensor is off, should it be left out for it.
        """
        if chi2 <= _CONTRADICTION:
            self._strikes = max(self._strikes - 1, 0)
            self._proofs += 1
            if self._proofs >= _PROOFS:
                self.reason = None
            return True
        self._proofs = 0
        self._strikes = min(self._strikes + (_STRIKES if chi2 > _GROSS else 1), _STRIKES)
        if self._strikes >= _STRIKES:
            self.reason = f'contradicts the images: {what}'
        return False


def corrected(
    state: NDArray[np.float64],  # (N,)
    P: NDArray[np.float64],  # (N, N)
    H: NDArray[np.float64],  # (M, N)
    innovation: NDArray[np.float64],  # (M,)
    noise: NDArray[np.float64],  # (M, M)
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return a Kalman filter's state and covariance after an innovation, and its chi2.

    The covariance is in Joseph's form, which rounding leaves positive.
    """
    S = H @ P @ H.T + noise
    gain = np.linalg.solve(S, H @ P).T
    kept = np.eye(len(state)) - gain @ H
    chi2 = float(innovation @ np.linalg.solve(S, innovation))
    return state + gain @ innovation, kept @ P @ kept.T + gain @ noise @ gain.T, chi2
