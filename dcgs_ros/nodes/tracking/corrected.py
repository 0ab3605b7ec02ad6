# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a correction did to the tracker's world; no ROS in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.keyframe import Correction


@dataclass(frozen=True)
class Corrected:
    """A correction that the tracker has taken."""

    applied: Correction  # of all keyframes, by their index
    named: Correction  # of those that the mapper may have, by the names that it has them under
    motions: NDArray[np.float64]  # (K, 4, 4) of the keyframes, from the old world to the new one
    here: NDArray[np.float64]  # (4, 4) the same of the camera
