# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Poses of keyframes that agree best with odometry and loops: Levenberg-Marquardt on SE(3).

Loops are weighted by the Geman-McClure kernel, which is made tight in steps (graduated
non-convexity, Yang et al. 2020): first all count, as a loop that corrects a long drift fits no
better than a wrong one; then those that the others contradict lose their weight.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

from . import linearisation
from .block_structure import BlockStructure
from .edges import Edge, EdgeArrays

LOOP_CHI2 = 22.46  # chi-square of 6 degrees of freedom, exceeded by one right loop of 1000
_HOPELESS_CHI2 = 10.0 * LOOP_CHI2
_ROUNDS = 3  # of leaving out what is hopeless, and beginning anew
_TIGHTER = 4.0  # a step of the graduation
_STEPS = 12  # of it at most
_FIRST, _LAST = 8, 8  # iterations with the first and the last kernel at most
# m and rad: the largest step of the last iteration. Convergence is quadratic, so that what is left
# is far smaller.
_CONVERGED = 1e-4
_SAME = 1e-4  # relative decrease of the cost that ends the iteration too
_LEAST_DAMPING, _WORTH, _MOST_DAMPING = 1e-9, 1e-4, 1e6  # relative to the diagonal


@dataclass(frozen=True)
class Solution:
    """The optimum of a pose graph."""

    T_world_cam: NDArray[np.float64]  # (K, 4, 4)
    weights: NDArray[np.float64]  # (E,) in [0, 1]; 1 for odometry


def optimise(
    poses: NDArray[np.float64], edges: Sequence[Edge], fixed: Collection[int]
) -> Solution:
    """Return the best poses from initial ones (K, 4, 4).

    Of each set of poses that edges connect, one must be among the `fixed`.
    """
    arrays = EdgeArrays.of(edges)
    poses = np.array(poses, np.float64)
    if not edges or len(poses) == len(set(fixed)):
        return Solution(poses, np.ones(len(edges)))
    graph = _Graph(arrays, len(poses), fixed)
    for _ in range(_ROUNDS):
        poses = _graduated(graph, poses)
        hopeless = graph.used & arrays.loop & (graph.chi2(poses) > _HOPELESS_CHI2)
        if not hopeless.any():
            break
        graph.used &= ~hopeless  # what they have pulled along may be right
    chi2 = graph.chi2(poses)
    if (chi2[arrays.loop] <= LOOP_CHI2).all():
        return Solution(poses, np.ones(len(edges)))
    return Solution(poses, graph.kernel(chi2, LOOP_CHI2))


def _graduated(graph: _Graph, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the optimum with the tight kernel, by way of wider ones."""
    poses = graph.minimise(poses, np.inf, _FIRST)
    loops = graph.edges.loop & graph.used
    worst = float(graph.chi2(poses)[loops].max(initial=0.0))
    if worst <= LOOP_CHI2:  # nothing contradicts: no need for a kernel
        return poses
    steps = min(int(np.ceil(np.log(2.0 * worst / LOOP_CHI2) / np.log(_TIGHTER))), _STEPS)
    for k in range(steps, 0, -1):
        poses = graph.minimise(poses, LOOP_CHI2 * _TIGHTER**k, 1)
    return graph.minimise(poses, LOOP_CHI2, _LAST)


class _Graph:
    """The structure of the normal equations, which poses and weights do not change."""

    def __init__(self, edges: EdgeArrays, poses: int, fixed: Collection[int]) -> None:
        self.edges = edges
        self.used = np.ones(len(edges.a), np.bool_)  # (E,) the others are left out
        free = np.ones(poses, np.bool_)
        free[list(fixed)] = False
        self.nodes = np.where(free, np.cumsum(free) - 1, -1)
        self.free = int(free.sum())
        pairs = np.stack([edges.a, edges.b], axis=1)
        self.structure = BlockStructure(self.nodes[pairs], self.free)

    def minimise(
        self, poses: NDArray[np.float64], scale: float, iterations: int
    ) -> NDArray[np.float64]:
        """Iterate from `poses` (K, 4, 4) with a kernel of this scale until steps are small."""
        damping = _LEAST_DAMPING
        errors, cost = self._evaluate(poses, scale)
        for _ in range(iterations):
            weights = self.used * self.kernel(self._chi2(errors), scale)
            blocks, gradient = self._equations(poses, errors, weights)
            moved, cost_before = poses, cost
            while damping <= _MOST_DAMPING:
                xi = self.structure.solve(blocks, gradient, damping)
                trial = np.empty_like(poses)
                linearisation.step(poses, self.nodes, xi, trial)
                errors_then, cost_then = self._evaluate(trial, scale)
                if cost_then <= cost * (1.0 + 1e-12):
                    moved, errors, cost = trial, errors_then, cost_then
                    damping = max(damping * 0.1, _LEAST_DAMPING)
                    break
                damping = max(damping * 100.0, _WORTH)
            if moved is poses:
                return poses
            poses = moved
            if np.abs(xi).max() < _CONVERGED or cost_before - cost <= _SAME * cost_before:
                break
        return poses

    def chi2(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the squared residuals (E,) in standard deviations."""
        return self._chi2(self._errors(poses))

    def kernel(self, chi2: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
        """Return the weights (E,) of edges with `chi2` (E,)."""
        if np.isinf(scale):
            return np.ones(len(chi2))
        return np.where(self.edges.loop, np.square(scale / (scale + chi2)), 1.0)

    def information(self, poses: NDArray[np.float64], weights: NDArray[np.float64]) -> csc_matrix:
        """Return the information matrix (6 F, 6 F) of the free poses."""
        blocks, _ = self._equations(poses, self._errors(poses), weights)
        return self.structure.matrix(blocks)

    def _errors(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        errors = np.empty((len(self.edges.a), 6))
        linearisation.residuals(poses, self.edges.a, self.edges.b, self.edges.T_b_a, errors)
        return errors

    def _chi2(self, errors: NDArray[np.float64]) -> NDArray[np.float64]:
        chi2 = np.empty(len(errors))
        linearisation.chi2(errors, self.edges.information, chi2)
        return chi2

    def _evaluate(
        self, poses: NDArray[np.float64], scale: float
    ) -> tuple[NDArray[np.float64], float]:
        """Return the residuals (E, 6) and the cost."""
        errors = self._errors(poses)
        chi2 = self._chi2(errors)
        if not np.isinf(scale):
            chi2 = np.where(self.edges.loop, scale * chi2 / (scale + chi2), chi2)
        return errors, float(chi2[self.used].sum())

    def _equations(
        self,
        poses: NDArray[np.float64],
        errors: NDArray[np.float64],
        weights: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the blocks (B, 6, 6) and the gradient (F, 6)."""
        blocks, gradient = np.zeros((self.structure.blocks, 6, 6)), np.zeros((self.free, 6))
        linearisation.accumulate(
            poses, self.edges.a, self.edges.b, errors, self.edges.information, weights,
            self.structure.slots, self.nodes, blocks, gradient,
        )  # fmt: skip
        return blocks, gradient
