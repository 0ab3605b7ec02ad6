# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""How the package compiles its kernels: Numba, cached on disk, GIL released, deterministic.

Parallel kernels split their work into CHUNKS fixed pieces, and sums are added up piece by piece,
so the result does not depend on the number of threads.
"""

from __future__ import annotations

import hashlib
import os
from functools import partial
from pathlib import Path

# An OpenMP team that spins between kernels starves the decoder, the mapper and the camera driver
# (measured: 8x on the median association). Read by libgomp when numba loads it, so before that.
os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
os.environ.setdefault('GOMP_SPINCOUNT', '0')

import cv2
import numba

CHUNKS = 16

# Files that kernels of other files take constants or code from.
_INLINED = (
    'kernels/jit.py', 'kernels/lens.py', 'kernels/small_matrix.py', 'mapping/splats.py',
    'render/renderer.py', 'render/simd.py', 'render/blending.py', 'render/projection.py',
)  # fmt: skip


def _separate_cache() -> None:
    """Give each version of the inlined functions a cache of its own.

    Numba stamps a cached kernel with its own file only: a function inlined from another file may
    change without the kernel being compiled again.
    """
    if numba.config.CACHE_DIR:
        return
    core = Path(__file__).parents[1]
    inlined = b''.join((core / name).read_bytes() for name in _INLINED)
    root = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache')
    numba.config.CACHE_DIR = str(root / 'dcgs_ros' / hashlib.sha256(inlined).hexdigest()[:12])


_separate_cache()

# No fast-math: a NaN must stay a NaN. Contraction and reassociation are what pays.
_MATH = {'contract', 'reassoc', 'nsz', 'arcp'}
kernel = partial(numba.njit, cache=True, nogil=True, fastmath=_MATH)
parallel_kernel = partial(kernel, parallel=True)
# Without Python's check for a division by zero, which keeps loops from being vectorised.
fast_kernel = partial(kernel, error_model='numpy')
# Numba puts a kernel's flags on every instruction in it, those of hand-written IR included, which
# brings its own (`render.simd`).
strict_kernel = partial(numba.njit, cache=True, nogil=True, error_model='numpy')
strict_inlined = partial(numba.njit, inline='always', error_model='numpy')
inlined = partial(numba.njit, inline='always', fastmath=_MATH)


def set_threads(count: int | None) -> int:
    """Choose the threads of OpenCV and of the kernels that the caller starts; tell how many."""
    count = set_kernel_threads(count)
    cv2.setNumThreads(count)
    return count


def set_kernel_threads(count: int | None) -> int:
    """Choose the threads of the kernels that the calling thread starts; tell how many.

    `None` leaves one core to whoever brings the frames: threads wait for the slowest of them, so
    sharing the last core with a decoder costs more than it gains.
    """
    available: int = numba.config.NUMBA_NUM_THREADS
    count = max(1, available - 1) if count is None else max(1, min(count, available))
    numba.set_num_threads(count)
    return count
