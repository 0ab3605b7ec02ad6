# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a pose graph knows of pairs of keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..keyframe import Odometry

# A tenth of a millimetre and of a milliradian: far below what any camera measures, and enough that
# the information of an edge is finite.
_FLOOR = 1e-8 * np.eye(6)


@dataclass(frozen=True)
class Edge:
    """Where keyframe b is, seen from keyframe a."""

    a: int
    b: int
    T_a_b: NDArray[np.float64]  # (4, 4)
    information: NDArray[np.float64]  # (6, 6) of xi in T_a_b exp(xi)
    loop: bool  # may be wrong, unlike odometry


@dataclass(frozen=True)
class EdgeArrays:
    """Edges for the kernels."""

    a: NDArray[np.int64]  # (E,)
    b: NDArray[np.int64]  # (E,)
    T_b_a: NDArray[np.float64]  # (E, 4, 4) measured
    information: NDArray[np.float64]  # (E, 6, 6)
    loop: NDArray[np.bool_]  # (E,)

    @classmethod
    def of(cls, edges: Sequence[Edge]) -> EdgeArrays:
        """Stack edges."""
        return cls(
            np.array([edge.a for edge in edges], np.int64),
            np.array([edge.b for edge in edges], np.int64),
            se3.inverse(np.array([edge.T_a_b for edge in edges]).reshape(-1, 4, 4)),
            np.array([edge.information for edge in edges]).reshape(-1, 6, 6),
            np.array([edge.loop for edge in edges], np.bool_),
        )


def information_of(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a covariance (6, 6), m and rad, that may be singular."""
    inverse = np.linalg.inv(covariance + _FLOOR)
    return 0.5 * (inverse + inverse.T)


def odometry_edges(odometry: Odometry) -> list[Edge]:
    """Return an edge from each host to a keyframe.

    They are one measurement, of which each holds some directions more than others.
    """
    return [
        Edge(int(host), odometry.keyframe, T, information, loop=False)
        for host, T, information in zip(
            odometry.hosts, odometry.T_host_cam, odometry.information, strict=True
        )
    ]
