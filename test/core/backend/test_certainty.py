# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Bounds of covariances against the exact marginals of small graphs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from walks import LOOP, ODOMETRY, Walk, round_block  # type: ignore[import-not-found]

from dcgs_ros.core import se3
from dcgs_ros.core.backend.certainty import bounds, steps
from dcgs_ros.core.backend.edges import Edge, EdgeArrays, information_of, odometry_edges
from dcgs_ros.core.backend.pose_graph import _Graph

CERTAIN = {0: np.zeros((6, 6))}
LOOPS = ((0, 28), (5, 33), (12, 20))


def exact(walk: Walk, loops: tuple[tuple[int, int], ...]) -> NDArray[np.float64]:
    """Return the marginal covariances (K, 6, 6) in the world; the first pose is certain."""
    edges = [edge for odometry in walk.odometry for edge in odometry_edges(odometry)]
    T = walk.tracked
    edges += [
        Edge(a, b, se3.inverse(T[a]) @ T[b], information_of(LOOP), loop=True) for a, b in loops
    ]
    graph = _Graph(EdgeArrays.of(edges), len(T), [0])
    information = graph.information(T, np.ones(len(edges)))
    covariance = np.linalg.inv(information.toarray()).reshape(len(T) - 1, 6, len(T) - 1, 6)
    out = np.zeros((len(T), 6, 6))
    for k in range(1, len(T)):
        Ad = se3.adjoint(T[k])
        out[k] = Ad @ covariance[k - 1, :, k - 1] @ Ad.T
    return out


@pytest.mark.parametrize('loops', [(), LOOPS[:1], LOOPS])
def test_no_marginal_exceeds_its_bound(loops: tuple[tuple[int, int], ...]) -> None:
    walk = round_block(36, seed=0, size_m=(3.0, 1.5))
    found = bounds(steps(walk.tracked, walk.odometry, [(a, b, LOOP) for a, b in loops]), CERTAIN)
    for bound, marginal in zip(found[1:], exact(walk, loops)[1:], strict=True):
        root = np.linalg.inv(np.linalg.cholesky(bound))
        assert np.linalg.eigvalsh(root @ marginal @ root.T)[-1] < 1.001
    mean = np.trace(found[:, :3, :3], axis1=1, axis2=2) / 3
    assert mean[-1] < 100 * np.trace(exact(walk, loops)[-1][:3, :3]) / 3  # nor is it useless


def test_a_chain_of_single_hosts_adds_up() -> None:
    """Then the bound is the covariance."""
    walk = round_block(8, seed=1)
    chain = [
        type(one)(one.keyframe, 0, one.hosts[-1:], one.T_host_cam[-1:],
                  one.information.sum(axis=0, keepdims=True)[: one.keyframe], one.covariance)
        for one in walk.odometry
    ]  # fmt: skip
    found = bounds(steps(walk.tracked, chain), CERTAIN)
    expected = np.zeros((6, 6))
    for k in range(1, 8):
        Ad = se3.adjoint(walk.tracked[k])
        expected = expected + Ad @ ODOMETRY @ Ad.T
        np.testing.assert_allclose(found[k], expected, rtol=2e-3, atol=1e-9)


def test_a_loop_makes_what_lies_behind_it_surer_and_backwards_too() -> None:
    walk = round_block(30, seed=2, size_m=(3.0, 1.5))
    without = bounds(steps(walk.tracked, walk.odometry), CERTAIN)
    joined = bounds(steps(walk.tracked, walk.odometry, [(0, 25, 1e-8 * np.eye(6))]), CERTAIN)
    sizes = [np.trace(found[:, 3:, 3:], axis1=1, axis2=2) for found in (without, joined)]
    assert sizes[1][25] < 0.01 * sizes[0][25]
    assert sizes[1][29] < 0.5 * sizes[0][29]
    assert sizes[1][23] < 0.5 * sizes[0][23]
    np.testing.assert_array_equal(sizes[1][:8], sizes[0][:8])


def test_what_nothing_joins_is_unknown() -> None:
    walk = round_block(6, seed=3)
    apart = list(walk.odometry)
    apart[3] = type(apart[3])(3, 1, *(v[:0] for v in (apart[3].hosts, apart[3].T_host_cam)),
                              np.empty((0, 6, 6)), np.zeros((6, 6)))  # fmt: skip
    apart[4:] = []
    found = bounds(steps(walk.tracked[:4], apart), CERTAIN)
    assert np.isfinite(found[:3]).all() and np.isinf(found[3]).all()
