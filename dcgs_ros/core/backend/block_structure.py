# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Sparse symmetric systems in blocks of 6x6: which blocks there are, and their solution."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csc_matrix
from scipy.sparse.linalg import splu


class BlockStructure:
    """The blocks of a system that pairs of its nodes fill, while their values change."""

    def __init__(self, pairs: NDArray[np.integer], nodes: int) -> None:
        """Find the blocks of `pairs` (P, 2) of `nodes`; -1 is a node that is not in the system."""
        self.nodes = nodes
        a, b = pairs.T.astype(np.int64)
        four = np.stack([np.stack(pair, 1) for pair in ((a, a), (a, b), (b, a), (b, b))], 1)
        keys = four[..., 0] * nodes + four[..., 1]
        there = (four >= 0).all(axis=2)
        diagonal = np.arange(nodes) * (nodes + 1)
        unique = np.unique(np.concatenate([keys[there], diagonal]))
        self.slots = np.where(there, np.searchsorted(unique, keys), -1)  # (P, 4) aa ab ba bb
        self._diagonal = np.searchsorted(unique, diagonal)
        self._columns = unique % max(nodes, 1)
        self._starts = np.searchsorted(unique, np.arange(nodes + 1) * nodes)

    @property
    def blocks(self) -> int:
        """How many blocks there are."""
        return len(self._columns)

    def matrix(self, blocks: NDArray[np.float64]) -> csc_matrix:
        """Return the symmetric matrix (6 F, 6 F) of its blocks (B, 6, 6)."""
        size = (6 * self.nodes, 6 * self.nodes)
        rows = bsr_matrix((blocks, self._columns, self._starts), size).tocsr()
        return csc_matrix((rows.data, rows.indices, rows.indptr), size)

    def solve(
        self, blocks: NDArray[np.float64], gradient: NDArray[np.float64], damping: float
    ) -> NDArray[np.float64]:
        """Return the step (F, 6) against the gradient (F, 6), damped relative to the diagonal."""
        damped, k = blocks.copy(), np.arange(6)
        damped[self._diagonal[:, None], k, k] *= 1.0 + damping
        step = -factorised(self.matrix(damped)).solve(gradient.ravel())
        return np.asarray(step).reshape(-1, 6)


def factorised(information: csc_matrix) -> splu:
    """Return the factors of a positive definite matrix, ordered for little fill-in."""
    return splu(
        information, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
        options={'SymmetricMode': True},
    )  # fmt: skip
