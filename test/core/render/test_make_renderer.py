# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which renderer a machine gets."""

from __future__ import annotations

import pytest

from dcgs_ros.core import render
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.render import make_renderer
from dcgs_ros.core.render.cpu import CpuRenderer
from dcgs_ros.core.render.renderer import RenderError


class Gpu:
    """Replaces the CUDA renderer."""


def no_gpu() -> None:
    raise RenderError('no CUDA device')


@pytest.mark.parametrize(
    ('driver', 'cuda', 'kind'),
    [(None, Gpu, CpuRenderer), ('nvidia-smi', Gpu, Gpu), ('nvidia-smi', no_gpu, CpuRenderer)],
)
def test_the_gpu_renders_where_there_is_one(
    monkeypatch: pytest.MonkeyPatch, driver: str | None, cuda: object, kind: type
) -> None:
    monkeypatch.setattr(render.shutil, 'which', lambda _: driver)
    monkeypatch.setattr(render.Path, 'exists', lambda _: False)
    monkeypatch.setattr(render, 'CudaRenderer', cuda)
    assert type(make_renderer(Workers(1))) is kind
