# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which loops to believe.

A floor that repeats itself, or a second shelf of the same kind, gives loops that fit as well as
right ones. They are told apart by the cycles that they close: with the odometry between their ends
(is it possible at all?), and with each other (pairwise consistency, Mangelson et al. 2018). A loop
is believed alone only where the odometry is so sure that nothing else is possible; otherwise other
views must tell the same, and clearly more of them than tell anything else.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .. import se3
from .certainty import Steps, bounds

_IMPOSSIBLE_CHI2 = 27.86  # of 6 degrees of freedom: one right loop of 10 000 is beyond
_CONTRADICTION_CHI2 = 22.46  # one right pair of 1000 is beyond
# A cycle that is known to less than this tells one place from the next one like it; otherwise it
# closes for wrong loops as well. Tiles, shelves and doors repeat themselves after more than twice
# 3 sigma.
_TELLING_M, _TELLING_RAD = 0.1, 0.1
_VIEW_M, _VIEW_RAD = 0.5, 0.35  # apart: views of which each tells something of its own
_VIEWS = 2  # that tell the same, at least
# The vaguer the odometry is, the more places like this one are possible, and each further view is
# taken to leave a quarter of them; up to where odometry says nothing at all.
_LEFT_BY_A_VIEW, _MOST_VIEWS = 0.25, 6
_MAJORITY = 2  # times as many views as tell anything else
_PENDING = 64  # loops that wait for others, at most: the newest
_REMEMBERED = 64  # impossible loops: the newest
_NEAR_M = 5.0  # from an impossible loop: the place may look like others in the same way


class Loop(Protocol):
    """Two keyframes that see the same place, as far as the images and the depth tell."""

    @property
    def a(self) -> int:
        """The earlier keyframe."""
        ...

    @property
    def b(self) -> int:
        """The later keyframe."""
        ...

    @property
    def T_a_b(self) -> NDArray[np.float64]:
        """(4, 4) measured."""
        ...

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(6, 6) of xi in T_a_b exp(xi), m and rad."""
        ...


@dataclass(frozen=True)
class Misfit:
    """How a cycle closes."""

    xi: NDArray[np.float64]  # (6,) the gap is exp(xi), m and rad
    covariance: NDArray[np.float64]  # (6, 6) of xi; infinite where nothing is known

    @cached_property
    def chi2(self) -> float:
        """Squared gap in standard deviations."""
        return self.chi2_of(self.xi)

    @cached_property
    def sigma_m(self) -> float:
        """Largest standard deviation of a translation."""
        return _largest_sigma(self.covariance[:3, :3])

    @cached_property
    def sigma_rad(self) -> float:
        """Largest standard deviation of a rotation."""
        return _largest_sigma(self.covariance[3:, 3:])

    @property
    def tells(self) -> bool:
        """Whether a wrong loop would not close it."""
        return self.sigma_m <= _TELLING_M and self.sigma_rad <= _TELLING_RAD

    @property
    def contradicts(self) -> bool:
        """Whether it does not close."""
        return self.chi2 > _CONTRADICTION_CHI2

    def chi2_of(self, xi: NDArray[np.float64]) -> float:
        """Return the squared length of another gap (6,) in standard deviations."""
        if not np.isfinite(self.covariance).all():
            return 0.0
        return float(xi @ np.linalg.solve(self.covariance, xi))


@dataclass(frozen=True)
class Surroundings:
    """The graph as seen from the two ends of a loop."""

    poses: NDArray[np.float64]  # (K, 4, 4)
    from_a: NDArray[np.float64]  # (K, 6, 6) covariances in the world, a being certain
    from_b: NDArray[np.float64]  # (K, 6, 6) b being certain

    @classmethod
    def of(cls, loop: Loop, poses: NDArray[np.float64], steps: Steps) -> Surroundings:
        """Look from the ends of a loop at keyframes at `poses` (K, 4, 4)."""
        zero = np.zeros((6, 6))
        return cls(poses, bounds(steps, {loop.a: zero}), bounds(steps, {loop.b: zero}))

    def prior(self, loop: Loop) -> Misfit:
        """Return how a loop closes with the odometry, and the loops before, between its ends."""
        T_world_b = self.poses[loop.b]
        gap = se3.inverse(loop.T_a_b) @ se3.inverse(self.poses[loop.a]) @ T_world_b
        covariance = loop.covariance + _seen_from(T_world_b, self.from_a[loop.b])
        return Misfit(se3.log(gap), covariance)

    def pair(self, loop: Loop, other: Loop) -> Misfit:
        """Return how `loop`, whose surroundings these are, agrees with another one.

        The other one is predicted as T_a'_a T_a_b T_b_b'.
        """
        T = self.poses
        Y = loop.T_a_b @ se3.inverse(T[loop.b]) @ T[other.b]  # T_a_b'
        gap = se3.inverse(other.T_a_b) @ se3.inverse(T[other.a]) @ T[loop.a] @ Y
        covariance = (
            other.covariance
            + _moved(se3.inverse(T[other.b]) @ T[loop.b], loop.covariance)
            + _seen_from(T[other.b], self.from_b[other.b])
            + _moved(se3.inverse(Y), _seen_from(T[loop.a], self.from_a[other.a]))
        )
        return Misfit(se3.log(gap), covariance)


@dataclass
class _Pending:
    """A loop that waits to be believed."""

    loop: Loop
    prior: Misfit
    support: set[int] = field(default_factory=set)  # serial numbers of loops that tell the same
    against: set[int] = field(default_factory=set)  # ... that contradict


class Consistency:
    """Collects loops until enough of them agree."""

    def __init__(self) -> None:
        """Start without loops."""
        self._pending: dict[int, _Pending] = {}
        self._refuted: list[tuple[Loop, Misfit]] = []  # loops that were impossible
        self._next = 0

    def add(self, loop: Loop, poses: NDArray[np.float64], steps: Steps) -> None:
        """Add a loop between keyframes at `poses` (K, 4, 4) with the `steps` between them."""
        around = Surroundings.of(loop, poses, steps)
        prior = around.prior(loop)
        if prior.chi2 > _IMPOSSIBLE_CHI2:
            self._refuted = [*self._refuted[1 - _REMEMBERED :], (loop, prior)]
            return
        new, serial = _Pending(loop, prior), self._next
        self._next += 1
        for other_serial, other in self._pending.items():
            misfit = around.pair(loop, other.loop)
            if misfit.contradicts:
                new.against.add(other_serial)
                other.against.add(serial)
            elif misfit.tells:
                new.support.add(other_serial)
                other.support.add(serial)
        self._pending[serial] = new
        if len(self._pending) > _PENDING:
            self._forget({min(self._pending)})

    def decide(self, poses: NDArray[np.float64]) -> list[Loop]:
        """Return the loops that are believed from now on; those that contradict are forgotten."""
        believed: list[Loop] = []
        for family in self._families():
            alive = family & self._pending.keys()
            if alive == family and self._is_believed(family, poses):
                believed += [self._pending[serial].loop for serial in sorted(family)]
                against = set().union(*(self._pending[serial].against for serial in family))
                self._forget(family | (against & self._pending.keys()))
        return believed

    def _is_believed(self, family: set[int], poses: NDArray[np.float64]) -> bool:
        """Return whether nothing else is possible, or enough views tell the same."""
        members = [self._pending[serial] for serial in family]
        surest = min(members, key=lambda member: member.prior.sigma_m)
        sure = surest.prior.tells and not surest.prior.contradicts
        against = set().union(*(member.against for member in members)) & self._pending.keys()
        others = [self._pending[serial].loop.b for serial in against]
        others += [loop.b for loop, gap in self._refuted if _is_alias(surest, loop, gap, poses)]
        wanted = max(
            1.0 if sure else _views_for(surest.prior.sigma_m), _MAJORITY * _views(others, poses)
        )
        ends = ([member.loop.a for member in members], [member.loop.b for member in members])
        return min(_views(end, poses) for end in ends) >= wanted

    def _families(self) -> list[set[int]]:
        """Return sets of loops that tell the same and do not contradict, the largest first.

        The largest clique is hard to find in general. Here each loop in turn begins a family.
        """
        found = {frozenset(self._family(serial)) for serial in self._pending}
        ordered = sorted(found, key=lambda family: (-len(family), sorted(family)))
        return [set(family) for family in ordered]

    def _family(self, serial: int) -> set[int]:
        """Return a loop with all that support it, or each other, and contradict none of them."""
        family, against = {serial}, set(self._pending[serial].against)
        waiting = [serial]
        while waiting:
            support = self._pending[waiting.pop(0)].support - family - against
            for other in sorted(support, key=lambda s: (-len(self._pending[s].support), s)):
                if other not in against:
                    family.add(other)
                    against |= self._pending[other].against
                    waiting.append(other)
        return family

    def _forget(self, serials: Iterable[int]) -> None:
        for serial in set(serials):
            del self._pending[serial]
        for pending in self._pending.values():
            pending.support &= self._pending.keys()
            pending.against &= self._pending.keys()


def _views(keyframes: Iterable[int], poses: NDArray[np.float64]) -> float:
    """Return how many views the keyframes have: one that is near an earlier one counts in part."""
    T = poses[sorted(set(keyframes))]
    R, t = T[:, :3, :3], T[:, :3, 3]
    far = np.linalg.norm(t[:, None] - t, axis=2)
    cosines = 0.5 * (np.einsum('aij,bij->ab', R, R) - 1.0)
    turned = np.arccos(np.clip(cosines, -1.0, 1.0))
    apart = np.maximum(far / _VIEW_M, turned / _VIEW_RAD)
    earlier = np.tri(len(T), k=-1, dtype=np.bool_)
    return float(apart.min(axis=1, initial=1.0, where=earlier).sum())


def _views_for(sigma_m: float) -> float:
    """Return how many views have to tell the same where odometry is known to `sigma_m`."""
    places = 1.0 + sigma_m / _TELLING_M
    return min(_VIEWS - math.log(places) / math.log(_LEFT_BY_A_VIEW), _MOST_VIEWS)


def _is_alias(pending: _Pending, loop: Loop, prior: Misfit, poses: NDArray[np.float64]) -> bool:
    """Return whether an impossible loop tells that a believable one may be wrong in the same way.

    The impossible one lies a period farther than the other, say. If that is wrong by the period as
    well, the truth lies as far on its other side: whether it can is asked of the odometry.
    """
    T = se3.inverse(poses[pending.loop.b]) @ poses[loop.b]
    if np.linalg.norm(T[:3, 3]) > _NEAR_M or not np.isfinite(prior.covariance).all():
        return False
    turned = np.concatenate([T[:3, :3] @ prior.xi[:3], T[:3, :3] @ prior.xi[3:]])
    mirrored = 2.0 * pending.prior.xi - turned
    return pending.prior.chi2_of(mirrored) <= _IMPOSSIBLE_CHI2


def _largest_sigma(covariance: NDArray[np.float64]) -> float:
    """Return the largest standard deviation along any direction of a covariance (3, 3)."""
    if not np.isfinite(covariance).all():
        return np.inf
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def _moved(T: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a twist after `Ad(T)`."""
    Ad = se3.adjoint(T)
    return np.asarray(Ad @ covariance @ Ad.T)


def _seen_from(
    T_world_k: NDArray[np.float64], in_world: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a covariance (6, 6) of the world in the frame of a keyframe; it may be infinite."""
    if not np.isfinite(in_world).all():
        return in_world
    return _moved(se3.inverse(T_world_k), in_world)
