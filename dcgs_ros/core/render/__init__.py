# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Renderers, and the choice between them."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from ..kernels.workers import Workers
from .cpu import CpuRenderer
from .cuda import CudaRenderer
from .renderer import Renderer, RenderError


def make_renderer(workers: Workers) -> Renderer:
    """Take the GPU where gsplat can use one, else these threads.

    Without NVIDIA's driver torch, which takes seconds to load, is not even looked for.
    """
    if shutil.which('nvidia-smi') or Path('/dev/nvidia0').exists():
        with contextlib.suppress(RenderError):
            return CudaRenderer()
    return CpuRenderer(workers)
