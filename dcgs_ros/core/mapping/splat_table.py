# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The mapper's Gaussians with what it stores of each, and selective Adam on them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..kernels.jit import fast_kernel
from ..kernels.workers import Workers
from ..render.renderer import Gradients
from ..render.simd import LANES
from .exposure import Exposure
from .splats import PLANES, SH_C0, Splats

_BETA_1, _BETA_2, _EPSILON = 0.9, 0.999, 1e-15
_STRETCH = 64  # Gaussians processed at a time
_TABLE = 8192  # visits after which a bias correction is 1 to the last bit
_PADDING_ID = np.iinfo(np.int64).min  # of the columns that fill up the last group
_FILLS = {'ids': _PADDING_ID, 'planes': -100.0, 'reach_m': np.inf}  # transparent, never clamped
_STEEPEST = 1e15  # largest gradient: its square is still finite


class SplatTable:
    """Gaussians in columns, in order of insertion; removing some closes the gaps.

    There are always whole groups of LANES columns, which the renderer needs: those after the last
    Gaussian are transparent padding.
    """

    def __init__(self) -> None:
        """Start empty."""
        self._count = 0
        self._columns: dict[str, NDArray[Any]] = {
            'planes': np.empty((len(PLANES), 0), np.float32),
            'first_moments': np.empty((len(PLANES), 0), np.float32),
            'second_moments': np.empty((len(PLANES), 0), np.float32),
            'visits': np.empty(0, np.int32),
            'weights': np.empty(0, np.float32),
            'ids': np.empty(0, np.int64),
            'hosts': np.empty(0, np.int32),
            'measured': np.empty((3, 0), np.float32),
            'anchors': np.empty((3, 0), np.float32),
            'reach_m': np.empty(0, np.float32),
            'reported': np.empty(0, np.int32),
        }
        steps = np.arange(1, _TABLE + 1)
        self._unbias_1 = (1.0 / (1.0 - _BETA_1**steps)).astype(np.float32)
        self._unbias_2 = (1.0 / (1.0 - _BETA_2**steps)).astype(np.float32)

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return self._count

    @property
    def planes(self) -> NDArray[np.float32]:
        """(14, M) parameters; those from N to M are padding."""
        return self._columns['planes']

    @property
    def splats(self) -> Splats:
        """The N Gaussians, a view of the table."""
        return Splats(self.planes[:, : self._count])

    @property
    def ids(self) -> NDArray[np.int64]:
        """(N,) ids; negative ones are of Gaussians that the mapper added."""
        return self._columns['ids'][: self._count]

    @property
    def hosts(self) -> NDArray[np.int32]:
        """(N,) index of the view that each was added with."""
        return self._columns['hosts'][: self._count]

    @property
    def measured(self) -> NDArray[np.float32]:
        """(3, N) means when they were added, metres, the tracker's world."""
        return self._columns['measured'][:, : self._count]

    @property
    def anchors(self) -> NDArray[np.float32]:
        """(3, N) the same in the mapper's world, metres, which moves with the views' poses."""
        return self._columns['anchors'][:, : self._count]

    @property
    def reach_m(self) -> NDArray[np.float32]:
        """(N,) largest distance of each mean from its anchor, metres."""
        return self._columns['reach_m'][: self._count]

    @property
    def visits(self) -> NDArray[np.int32]:
        """(N,) optimisation steps that moved each."""
        return self._columns['visits'][: self._count]

    @property
    def weights(self) -> NDArray[np.float32]:
        """(N,) largest sum of blending weights that each had in one image, pixels."""
        return self._columns['weights'][: self._count]

    def report(self) -> NDArray[np.int64]:
        """Return the columns (K,) of the tracker's Gaussians that moved since the last call."""
        reported = self._columns['reported'][: self._count]
        moved = (self.ids >= 0) & (self.visits != reported)
        reported[moved] = self.visits[moved]
        return np.flatnonzero(moved)

    def recolor(self, exposure: Exposure) -> None:
        """Apply an exposure to the colours."""
        sh_dc = self.splats.sh_dc
        sh_dc *= exposure.gain[:, None]
        sh_dc += ((0.5 * (exposure.gain - 1) + exposure.offset) / np.float32(SH_C0))[:, None]

    def append(
        self,
        splats: Splats,
        ids: NDArray[np.int64],  # (N,)
        host: int | NDArray[np.int32],  # of all, or (N,) of each
        measured: NDArray[np.float32],  # (3, N) means in the tracker's world, metres
        reach_m: NDArray[np.float32],  # (N,) largest distance of a mean from there
    ) -> None:
        """Add Gaussians of the view `host`; their anchors are their means."""
        new: dict[str, NDArray[Any]] = {
            'planes': splats.planes,
            'first_moments': np.zeros_like(splats.planes),
            'second_moments': np.zeros_like(splats.planes),
            'visits': np.zeros(len(splats), np.int32),
            'weights': np.zeros(len(splats), np.float32),
            'ids': ids,
            'hosts': np.full(len(splats), host, np.int32),
            'measured': measured,
            'anchors': splats.means,
            'reach_m': reach_m,
            'reported': np.zeros(len(splats), np.int32),
        }
        old = {name: column[..., : self._count] for name, column in self._columns.items()}
        self._replace(self._count + len(ids), old, new)

    def anchor(self, T_map_tracked: NDArray[np.float64]) -> None:
        """Move the anchors with their views, and clamp the means to their reach, as `step` does.

        `T_map_tracked` (K, 4, 4) is, for each view, from the tracker's world to the mapper's.
        """
        self.place_anchors(T_map_tracked)
        means = self.splats.means
        moved = means - self.anchors
        far = np.linalg.norm(moved, axis=0)
        out = np.flatnonzero(far > self.reach_m)
        share = self.reach_m[out] / far[out]
        means[:, out] = self.anchors[:, out] + share * moved[:, out]

    def place_anchors(self, T_map_tracked: NDArray[np.float64]) -> None:
        """Move the anchors with their views, as `anchor`, and leave the means."""
        T = T_map_tracked[self.hosts]
        self.anchors[:] = np.einsum('nij,jn->in', T[:, :3, :3], self.measured) + T[:, :3, 3].T

    def move(
        self,
        motions: NDArray[np.float64],  # (K, 4, 4) of each view, in the tracker's world
        in_map: NDArray[np.float64],  # (K, 4, 4) in the mapper's
        moved: NDArray[np.bool_],  # (K,) which of them are not the identity
    ) -> None:
        """Move the Gaussians with their views: means, axes of Sigma_r, and what Adam keeps.

        The first moments turn with the gradients. Of the second ones, a variance for each axis,
        the turned ellipsoid's diagonal stays. Reset to zero, they would let the next step be three
        times the learning rate.
        """
        columns = np.flatnonzero(moved[self.hosts])
        hosts = self.hosts[columns]
        parts = ((motions, (self.measured,)), (in_map, (self.splats.means, self.anchors)))
        for T, moving in parts:
            R, t = T[hosts, :3, :3], T[hosts, :3, 3]
            for points in moving:
                points[:, columns] = _turned(R, points[:, columns]) + t.T
        products = _left_products(se3.to_quaternion(in_map))[hosts]
        quats = self.splats.quats_wxyz
        quats[:, columns] = _turned(products, quats[:, columns])
        first, second = (self._columns[f'{name}_moments'] for name in ('first', 'second'))
        for rows, turns in ((slice(0, 3), R), (slice(6, 10), products)):
            first[rows, columns] = _turned(turns, first[rows, columns])
            second[rows, columns] = _turned(turns**2, second[rows, columns])

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Remove the Gaussians outside `mask` (N,)."""
        kept = np.flatnonzero(mask)
        self._replace(len(kept), {name: c[..., kept] for name, c in self._columns.items()})

    def _replace(self, count: int, *parts: dict[str, NDArray[Any]]) -> None:
        """Replace the columns by those of the parts, `count` in all, padded to whole groups."""
        self._count = count
        for name, column in self._columns.items():
            shape = (*column.shape[:-1], -count % LANES)
            padding = np.full(shape, _FILLS.get(name, 0), column.dtype)
            pieces = [*(part[name] for part in parts), padding]
            self._columns[name] = np.concatenate(pieces, axis=-1)

    def step(
        self,
        gradients: Gradients,  # by all columns
        rates: NDArray[np.float32],  # (14,) of PLANES
        workers: Workers,
    ) -> None:
        """Move the Gaussians that have a gradient by one step of Adam (Kingma and Ba 2015).

        The others keep their moments; bias correction counts the visits of each Gaussian. A mean
        beyond its reach is clamped to it.
        """
        c = self._columns
        workers.run(
            _adam, c['planes'], c['first_moments'], c['second_moments'], c['visits'],
            c['weights'], gradients.planes, gradients.touched, gradients.weights, rates,
            self._unbias_1, self._unbias_2, c['anchors'], c['reach_m'],
        )  # fmt: skip


def _turned(matrices: NDArray[np.float64], vectors: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the vectors (D, N) multiplied by a matrix each (N, D, D)."""
    return np.einsum('nij,jn->in', matrices, vectors)


def _left_products(quats_wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return for each quaternion q (K, 4) the orthogonal L (K, 4, 4) with L p = q p."""
    w, x, y, z = quats_wxyz.T
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return np.moveaxis(np.array(rows), -1, 0)


@fast_kernel
def _adam(
    piece, pieces, planes, first, second, visits, best_weights, gradients, touched, weights, rates,
    unbias_1, unbias_2, anchors, reach_m,
):  # fmt: skip
    """Take one step of Adam on the piece's Gaussians that are touched, and clamp their means.

    Writes `planes`, `first` and `second` (14, N) float32 parameters and moments, `visits` (N,)
    int32 and `best_weights` (N,) float32. Reads `gradients` (14, N), `touched` (N,) bool,
    `weights` (N,), `rates` (14,), `unbias_1` and `unbias_2` (_TABLE,) bias corrections by visit,
    `anchors` (3, N) and `reach_m` (N,) metres.
    """
    groups = planes.shape[1] // LANES
    start_of_piece = piece * groups // pieces * LANES
    end_of_piece = (piece + 1) * groups // pieces * LANES
    scale_1, scale_2 = np.empty(_STRETCH, np.float32), np.empty(_STRETCH, np.float32)
    for start in range(start_of_piece, end_of_piece, _STRETCH):
        end = min(start + _STRETCH, end_of_piece)
        if not touched[start:end].any():
            continue
        for i in range(start, end):
            if touched[i]:
                visits[i] += 1
                best_weights[i] = max(best_weights[i], weights[i])
            visit = min(max(visits[i], 1), _TABLE) - 1
            scale_1[i - start], scale_2[i - start] = unbias_1[visit], unbias_2[visit]
        for k in range(planes.shape[0]):
            _move(
                planes[k, start:end], first[k, start:end], second[k, start:end],
                gradients[k, start:end], touched[start:end], scale_1, scale_2, rates[k],
            )  # fmt: skip
        for i in range(start, end):
            x, y = planes[0, i] - anchors[0, i], planes[1, i] - anchors[1, i]
            z = planes[2, i] - anchors[2, i]
            far = x * x + y * y + z * z
            if touched[i] and far > reach_m[i] * reach_m[i]:
                share = reach_m[i] / np.sqrt(far)
                planes[0, i] = anchors[0, i] + share * x
                planes[1, i] = anchors[1, i] + share * y
                planes[2, i] = anchors[2, i] + share * z


@fast_kernel
def _move(values, first, second, gradients, touched, scale_1, scale_2, rate):
    """Take one step of Adam on one parameter of n <= _STRETCH Gaussians.

    Writes `values`, `first` and `second` (n,) float32. Reads `gradients` and `touched` (n,), the
    bias corrections `scale_1` and `scale_2` (_STRETCH,), and the learning rate. As arguments LLVM
    can check that the rows do not overlap, so that it vectorises.
    """
    steepest, zero = np.float32(_STEEPEST), np.float32(0.0)
    for x in range(values.shape[0]):
        g = min(max(gradients[x], -steepest), steepest)
        g = g if touched[x] else zero  # it is undefined if not touched
        share_1 = np.float32(1.0 - _BETA_1) if touched[x] else zero
        share_2 = np.float32(1.0 - _BETA_2) if touched[x] else zero
        m = first[x] + share_1 * (g - first[x])
        v = second[x] + share_2 * (g * g - second[x])
        first[x], second[x] = m, v
        step = rate * scale_1[x] * m / (np.sqrt(v * scale_2[x]) + np.float32(_EPSILON))
        values[x] -= step if touched[x] else zero
