# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The renderers, and the choice between them."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from ..kernels.workers import Workers
from .cpu import CpuRenderer
from .cuda import CudaRenderer
from .renderer import Renderer, RenderError


def make_renderer(workers: Workers) -> Renderer:
    """Return the CUDA renderer if gsplat can use a GPU, else the CPU renderer on `workers`.

    torch, which takes seconds to load, is only imported if there is an NVIDIA driver.
    """
    if shutil.which('nvidia-smi') or Path('/dev/nvidia0').exists():
        with contextlib.suppress(RenderError):
            return CudaRenderer()
    return CpuRenderer(workers)
