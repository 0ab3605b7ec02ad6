# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How sure the poses of a pose graph are: upper bounds that need no inverse of the whole graph.

A keyframe is placed relative to its hosts, so its covariance is at most theirs, weighted by their
shares, and its own in addition, whatever the correlation of the hosts is. It is also at most that
of any single neighbour and of the edge from there. Of these bounds the smallest is passed on until
nothing changes, as along a shortest path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..kernels.jit import kernel
from ..keyframe import Odometry

_SWEEPS = 20  # there and back; two or three do where there are few loops
_GAIN = 1e-3  # relative decrease of the size that is passed on


@dataclass(frozen=True)
class Steps:
    """Covariances of all edges in the world, of eps in exp(eps) T, where they simply add up."""

    positions: NDArray[np.float64]  # (K, 3) of the keyframes
    starts: NDArray[np.int64]  # (K + 1,) of each keyframe's edges in the following
    others: NDArray[np.int64]  # (S,) the keyframe at the other end
    shares: NDArray[np.float64]  # (S,) of the keyframe's odometry; 0: other edges
    covariances: NDArray[np.float64]  # (S, 6, 6) of the edge alone
    own: NDArray[np.float64]  # (K, 6, 6) of the keyframe's odometry as a whole


def steps(
    poses: NDArray[np.float64],
    odometry: Sequence[Odometry],
    loops: Sequence[tuple[int, int, NDArray[np.float64]]] = (),
) -> Steps:
    """Return the steps between keyframes at `poses` (K, 4, 4).

    A loop is a pair of keyframes and the covariance (6, 6) of its edge in the second one's frame.
    """
    Ad = se3.adjoint(poses)
    own = Ad @ np.array([one.covariance for one in odometry]).reshape(-1, 6, 6)
    own = own @ Ad.transpose(0, 2, 1)
    owners = np.repeat(np.arange(len(poses)), [len(one.hosts) for one in odometry])
    hosts = np.concatenate([np.empty(0, np.int64), *(one.hosts for one in odometry)])
    shares = np.concatenate([np.empty(0), *(one.shares for one in odometry)])
    a = np.array([loop[0] for loop in loops], np.int64)
    b = np.array([loop[1] for loop in loops], np.int64)
    of_loops = Ad[b] @ np.array([loop[2] for loop in loops]).reshape(-1, 6, 6)
    of_loops = of_loops @ Ad[b].transpose(0, 2, 1)
    of_hosts = own[owners] / shares[:, None, None]
    ends = np.concatenate([owners, hosts, a, b])
    order = np.argsort(ends, kind='stable')
    return Steps(
        np.ascontiguousarray(poses[:, :3, 3]),
        np.searchsorted(ends[order], np.arange(len(poses) + 1)),
        np.concatenate([hosts, owners, b, a])[order].astype(np.int64),
        np.concatenate([shares, np.zeros(len(hosts) + 2 * len(a))])[order],
        np.concatenate([of_hosts, of_hosts, of_loops, of_loops])[order],
        own,
    )


def bounds(steps: Steps, known: Mapping[int, NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return covariances (K, 6, 6), in the world, that the poses' own do not exceed.

    `known` are those (6, 6) of some keyframes. What no edge joins to these is infinite.
    """
    covariances = np.full(steps.own.shape, np.inf)
    sizes = np.full(len(covariances), np.inf)
    for k, covariance in known.items():
        covariances[k], sizes[k] = covariance, -1.0  # never replaced
    _relax(
        steps.positions, steps.starts, steps.others, steps.shares, steps.covariances, steps.own,
        covariances, sizes,
    )  # fmt: skip
    return covariances


@kernel
def _relax(positions, starts, others, shares, steps, own, covariances, sizes):
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
            first, last = starts[k], starts[k + 1]
            better = False
            share = 0.0
            hosted = own[k].copy()
            for e in range(first, last):
                other = others[e]
                if sizes[other] == np.inf:
                    share -= shares[e]
                    continue
                share += shares[e]
                if shares[e] > 0.0:
                    hosted += shares[e] * covariances[other]
                better |= _offer(k, positions, covariances[other] + steps[e], covariances, sizes)
            if share > 0.999:  # of all hosts
                better |= _offer(k, positions, hosted, covariances, sizes)
            if better:
                stale[others[first:last]] = True
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
