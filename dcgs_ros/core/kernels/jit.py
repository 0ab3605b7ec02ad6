# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Numba decorators of the package: cached on disk, GIL released, deterministic.

Parallel kernels split their work into CHUNKS fixed pieces and sums are added up piece by piece,
so that the result does not depend on the number of threads.
"""

from __future__ import annotations

import hashlib
import os
from functools import partial
from pathlib import Path

# OpenMP threads that spin between kernels slow down the decoder, the mapper and the camera driver
# (measured: 8x on the median association). libgomp reads these when numba loads it.
os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
os.environ.setdefault('GOMP_SPINCOUNT', '0')

import cv2
import numba

CHUNKS = 16

# Files whose constants or functions are compiled into kernels of other files.
_INLINED = (
    'backend/linearisation.py', 'kernels/jit.py', 'kernels/lens.py', 'kernels/small_matrix.py',
    'mapping/rectification.py',
    'mapping/splats.py', 'render/renderer.py', 'render/simd.py', 'render/blending.py',
    'render/projection.py', 'se3.py', 'tracking/factors.py',
)  # fmt: skip


def _separate_cache() -> None:
    """Use a cache folder named by the contents of the inlined files.

    Numba compares a cached kernel with the time stamp of its own file only, so it would not notice
    that a function inlined from another file has changed.
    """
    if numba.config.CACHE_DIR:
        return
    core = Path(__file__).parents[1]
    inlined = b''.join((core / name).read_bytes() for name in _INLINED)
    root = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache')
    numba.config.CACHE_DIR = str(root / 'dcgs_ros' / hashlib.sha256(inlined).hexdigest()[:12])


_separate_cache()

# Not all of fast-math: NaN must stay NaN. Contraction and reassociation give nearly all the speed.
_MATH = {'contract', 'reassoc', 'nsz', 'arcp'}
kernel = partial(numba.njit, cache=True, nogil=True, fastmath=_MATH)
parallel_kernel = partial(kernel, parallel=True)
# Without Python's check for division by zero, which prevents vectorisation.
fast_kernel = partial(kernel, error_model='numpy')
# No flags: Numba would also put them on hand-written IR, which sets its own (`render.simd`).
strict_kernel = partial(numba.njit, cache=True, nogil=True, error_model='numpy')
strict_inlined = partial(numba.njit, inline='always', error_model='numpy')
inlined = partial(numba.njit, inline='always', fastmath=_MATH)


def set_threads(count: int | None) -> int:
    """Set the number of threads of OpenCV and of the caller's kernels; return it."""
    count = set_kernel_threads(count)
    cv2.setNumThreads(count)
    return count


def set_kernel_threads(count: int | None) -> int:
    """Set the number of threads of the kernels that the calling thread starts; return it.

    `None` leaves one core free for the source of the frames: kernels wait for their slowest
    thread, so sharing the last core with a decoder costs more than it gains.
    """
    available: int = numba.config.NUMBA_NUM_THREADS
    count = max(1, available - 1) if count is None else max(1, min(count, available))
    numba.set_num_threads(count)
    return count
