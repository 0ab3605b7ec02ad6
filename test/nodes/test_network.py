# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The mapper on another machine, behind 100 Mbit/s, 20 ms and a lost packet in a hundred."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

import wire  # type: ignore[import-not-found]

ROOT = Path(__file__).resolve().parents[2]
LACKING = wire.why_not()
KEYFRAME_BYTES = 640 * 480 * 5  # colour and depth
ENDED_S = 1200.0


@pytest.mark.slow
@pytest.mark.skipif(LACKING is not None, reason=f'no namespaces and wire: {LACKING}')
def test_every_pair_is_tracked_and_every_keyframe_arrives(tmp_path: Path) -> None:
    script = Path(__file__).with_name('two_machines.py')
    ended = subprocess.run(
        [sys.executable, str(script), str(tmp_path)],
        env=os.environ | {'PYTHONPATH': str(ROOT)},
        capture_output=True, text=True, timeout=ENDED_S,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    found = json.loads(ended.stdout)
    assert found['tracked'] == found['pairs']
    assert found['of_mapper'] >= found['keyframes'] > 0  # the mapper has views between them too
    # They came over the wire.
    assert found['received_bytes'] > found['keyframes'] * KEYFRAME_BYTES
