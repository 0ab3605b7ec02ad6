# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The renderer and the number of threads that the mapper gets."""

from __future__ import annotations

import pytest

from dcgs_ros.cli.run import pipeline
from dcgs_ros.core import render
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.render import make_renderer
from dcgs_ros.core.render.cpu import CpuRenderer
from dcgs_ros.core.render.renderer import RenderError


def test_lockstep_takes_all_cores_and_online_leaves_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for cores, lockstep, online in ((8, 8, 7), (2, 2, 1), (1, 1, 1)):
        monkeypatch.setattr(pipeline, 'cores', lambda cores=cores: cores)
        assert pipeline.mapper_threads(Config(), online=False) == lockstep
        assert pipeline.mapper_threads(Config(), online=True) == online
    assert pipeline.mapper_threads(Config(threads=3), online=True) == 3


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
