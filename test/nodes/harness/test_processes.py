# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Several `Processes` on one host."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip('rclpy')

from dcgs_ros.nodes.harness import processes as module
from dcgs_ros.nodes.harness.processes import Processes


def test_no_two_use_one_domain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, '_DOMAINS', 2)
    with Processes(tmp_path) as one:
        with Processes(tmp_path) as other:
            assert {one.domain, other.domain} == {0, 1}
            with pytest.raises(OSError, match='all of 2 ROS domains'):
                Processes(tmp_path)
        with Processes(tmp_path) as third:
            assert third.domain != one.domain
