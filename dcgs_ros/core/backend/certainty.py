# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How sure the poses of a pose graph are: upper bounds that need no inverse of the whole graph.

Relative to its first n hosts a keyframe is as sure as they make it, and they are as sure as the
least sure of them, whatever their correlation is. It is also at most as unsure as any single
neighbour and the edge from there. Of these bounds the smallest is passed on until nothing changes,
as along a shortest path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..kernels.jit import kernel
from ..keyframe import Odometry
from ..tracking.hosting import VAGUE

_SWEEPS = 20  # there and back; two or three do where there are few loops
_GAIN = 1e-3  # relative decrease of the size that is passed on


@dataclass(frozen=True)
class Steps:
    """Covariances of all edges in the world, of eps in exp(eps) T, where they simply add up."""

    positions: NDArray[np.float64]  # (K, 3) of the keyframes
    starts: NDArray[np.int64]  # (K + 1,) of each keyframe's edges in the following, hosts first
    others: NDArray[np.int64]  # (S,) the keyframe at the other end
    hosts: NDArray[np.bool_]  # (S,) whether that is a host
    covariances: NDArray[np.float64]  # (S, 6, 6) of the edge; of a host's, with those before it


def steps(
    poses: NDArray[np.float64],
    odometry: Sequence[Odometry],
    loops: Sequence[tuple[int, int, NDArray[np.float64]]] = (),
) -> Steps:
    """Return the steps between keyframes at `poses` (K, 4, 4).

    A loop is a pair of keyframes and the covariance (6, 6) of its edge in the second one's frame.
    """
    Ad = se3.adjoint(poses)
    owners = np.repeat(np.arange(len(poses)), [len(one.hosts) for one in odometry])
    hosts = np.concatenate([np.empty(0, np.int64), *(one.hosts for one in odometry)])
    alone = np.concatenate([np.empty((0, 6, 6)), *(one.information for one in odometry)])
    together = [np.cumsum(one.information, axis=0) for one in odometry]
    a = np.array([loop[0] for loop in loops], np.int64)
    b = np.array([loop[1] for loop in loops], np.int64)
    of_loops = np.array([loop[2] for loop in loops]).reshape(-1, 6, 6)
    ends = np.concatenate([owners, hosts, a, b])
    frames = np.concatenate([owners, owners, b, b])
    covariances = np.linalg.inv(np.concatenate([np.empty((0, 6, 6)), *together, alone]) + VAGUE)
    covariances = np.concatenate([covariances, of_loops, of_loops])
    order = np.argsort(ends, kind='stable')
    return Steps(
        np.ascontiguousarray(poses[:, :3, 3]),
        np.searchsorted(ends[order], np.arange(len(poses) + 1)),
        np.concatenate([hosts, owners, b, a])[order].astype(np.int64),
        (np.arange(len(ends)) < len(hosts))[order],
        (Ad[frames] @ covariances @ Ad[frames].transpose(0, 2, 1))[order],
    )


def bounds(steps: Steps, known: Mapping[int, NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return covariances (K, 6, 6), in the world, that the poses' own do not exceed.

    `known` are those (6, 6) of some keyframes. What no edge joins to these is infinite.
    """
    count = len(steps.positions)
    covariances = np.full((count, 6, 6), np.inf)
    sizes = np.full(count, np.inf)
    for k, covariance in known.items():
        covariances[k], sizes[k] = covariance, -1.0  # never replaced
    _relax(
        steps.positions, steps.starts, steps.others, steps.hosts, steps.covariances, covariances,
        sizes,
    )  # fmt: skip
    return covariances


@kernel
def _relax(positions, starts, others, hosts, steps, covariances, sizes):
    """Lower `covariances` (K, 6, 6) and their `sizes` (K,) until nothing changes.

    Only what is next to a change is looked at again.
    """
    count = len(sizes)
    stale = np.ones(count, np.bool_)
    for sweep in range(2 * _SWEEPS):
        changed = False
        for n in range(count):
            k = n if sweep % 2 == 0 else count - 1 - n
            if sizes[k] < 0.0 or not stale[k]:
                continue
            stale[k] = False
            better = False
            worst = -1  # of the hosts so far
            for e in range(starts[k], starts[k + 1]):
                other = others[e]
                if hosts[e] and worst >= 0 and sizes[worst] > sizes[other]:
                    other = worst
                worst = other
                if sizes[other] < np.inf:
                    bound = covariances[other] + steps[e]
                    better |= _offer(k, positions, bound, covariances, sizes)
            if better:
                stale[others[starts[k] : starts[k + 1]]] = True
                changed = True
        if not changed and sweep > 0:
            break


@kernel
def _offer(k, positions, bound, covariances, sizes):
    """Take a `bound` (6, 6) of keyframe `k` if it is smaller; return whether it is."""
    size = _size(bound, positions[k])
    if size < sizes[k] * (1.0 - _GAIN) or (sizes[k] == np.inf and size < np.inf):
        covariances[k] = bound
        sizes[k] = size
        return True
    return False


@kernel
def _size(covariance, position):
    """Return the variance of a position (3,), m^2, and of the rotation over a metre.

    It is the trace of A C A^T, where A is [I, -[position]x; 0, I].
    """
    C, (x, y, z) = covariance, position
    spread = C[0, 0] + C[1, 1] + C[2, 2] + C[3, 3] + C[4, 4] + C[5, 5]
    spread += z * z * (C[3, 3] + C[4, 4]) + y * y * (C[3, 3] + C[5, 5])
    spread += x * x * (C[4, 4] + C[5, 5])
    spread += 2.0 * (z * (C[0, 4] - C[1, 3]) + y * (C[2, 3] - C[0, 5]) + x * (C[1, 5] - C[2, 4]))
    return spread - 2.0 * (y * z * C[4, 5] + x * z * C[3, 5] + x * y * C[3, 4])
