# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Pose matrices: rigid ones are accepted, the others are not."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dcgs_ros.core import se3
from dcgs_ros.datasets.parsing.pose_matrices import are_rigid, rigid_trajectory


def test_without_any_pose_there_is_no_truth() -> None:
    assert rigid_trajectory(np.arange(3), np.full((3, 4, 4), -np.inf, np.float32)) is None


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_rigid_motions_are_poses_in_float32_too(motion: list[float]) -> None:
    T = se3.exp(np.array(motion))
    assert are_rigid(np.stack([T, T.astype(np.float32), np.round(T, 6)])).all()
