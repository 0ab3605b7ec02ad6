# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Fixtures of the command line's tests."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
from running import SMALL_CAMERA, SMALL_ROOM, Run, run_into  # type: ignore[import-not-found]

from dcgs_ros.datasets.synthetic.sensors.catalogue import SENSORS
from dcgs_ros.evaluation import scoring


@pytest.fixture(scope='module')
def small_images() -> Iterator[None]:
    """Let synthetic sources render a sixteenth of the pixels, and leave LPIPS out."""
    with pytest.MonkeyPatch.context() as patch:
        for name, kind in SENSORS.items():
            patch.setitem(SENSORS, name, replace(kind, camera=SMALL_CAMERA))
        patch.setattr(scoring.Lpips, 'load', lambda: None)
        yield


@pytest.fixture(scope='module')
def mapped(small_images: None, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Map a few small images, once per module."""
    return run_into(tmp_path_factory.mktemp('runs') / 'mapped', *SMALL_ROOM)
