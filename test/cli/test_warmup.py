# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""After the warm-up no frame waits for a compiler."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CODE = """
import sys
from dcgs_ros.core.config import Config
from dcgs_ros.core.tracker import Tracker
from dcgs_ros.core.warmup import warm_up
from dcgs_ros.datasets.open import open_source

def compiled():
    '''Count the signatures of every kernel of core.'''
    counts = {{}}
    for name, module in list(sys.modules.items()):
        if name.startswith('dcgs_ros.core'):
            for key, value in vars(module).items():
                if hasattr(value, 'nopython_signatures'):
                    counts[name + '.' + key] = len(value.signatures)
    return counts

source = open_source('synthetic:room?frames=30&sensor=ideal&speed=2')
config = Config(ablation={ablation!r}, sensor=source.sensor)
warm_up(source.camera, config)
before = compiled()
assert any(before.values())
tracker = Tracker(source.camera, config)
results = [tracker.track(source.render(k)) for k in range(0, 30, 3)]
assert sum(result.keyframe for result in results) >= 2
after = compiled()
assert before == after, {{key: after[key] for key in after if after[key] != before.get(key)}}
"""


@pytest.mark.parametrize('ablation', ['full', 'shared'])
def test_a_run_compiles_nothing_that_the_warm_up_did_not(ablation: str) -> None:
    done = subprocess.run(
        [sys.executable, '-c', CODE.format(ablation=ablation)],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
