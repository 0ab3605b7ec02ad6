# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Facts about the machine, and the memory of processes."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

from dcgs_ros.core.kernels.workers import cores
from dcgs_ros.evaluation.host import machine, peak_rss_mb, rss_mb

linux_only = pytest.mark.skipif(sys.platform != 'linux', reason='reads /proc')


def test_the_machine_is_named_with_its_cores_and_python() -> None:
    assert machine().startswith(f'{cores()} x ')
    assert machine().endswith(f'Python {platform.python_version()}')


@linux_only
def test_memory_is_at_most_its_peak() -> None:
    now_mb, peak_mb = rss_mb(), peak_rss_mb()
    assert now_mb is not None and peak_mb is not None
    assert 1.0 < now_mb <= peak_mb


@linux_only
def test_memory_of_other_processes() -> None:
    parent_mb = rss_mb(os.getppid())
    assert parent_mb is not None and parent_mb > 0.1
    ended = subprocess.Popen(['true'])
    ended.wait()
    assert rss_mb(ended.pid) is None
