# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Transforms between the frames of a recording."""

from __future__ import annotations

import numpy as np
import pytest

from dcgs_ros.core import se3
from dcgs_ros.datasets.bag.extrinsics import transform_between
from dcgs_ros.io.ros_images import MessageError

EXACT = 1e-12  # metres
T_ROOT = se3.exp(np.array([0.1, 0.2, -0.3, 0.5, -0.7, 1.1]))
T_A_B = se3.exp(np.array([0.015, -0.002, 0.001, 0.01, -0.02, 0.03]))


def test_transforms_are_composed_up_and_down_a_tree() -> None:
    tree = {'a': ('root', T_ROOT), 'b': ('a', T_A_B), 'c': ('root', np.eye(4))}
    T_c_b = transform_between(tree, 'c', 'b')
    assert T_c_b is not None
    np.testing.assert_allclose(T_c_b, T_ROOT @ T_A_B, atol=EXACT)
    T_b_c = transform_between(tree, 'b', 'c')
    assert T_b_c is not None
    np.testing.assert_allclose(T_b_c @ T_c_b, np.eye(4), atol=EXACT)
    assert transform_between(tree, 'c', 'elsewhere') is None
    with pytest.raises(MessageError, match="'a' is above itself"):
        transform_between({'a': ('b', T_ROOT), 'b': ('a', T_ROOT)}, 'a', 'b')
