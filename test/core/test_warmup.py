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
from dataclasses import replace
from dcgs_ros.cli.run import pipeline
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.tracking.warmup import EVERY_FRAME
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
few = {{'mapping.spawn_stride_px': 16, 'mapping.steps_per_frame': 2, 'mapping.final_steps': 5}}
few |= {{'mapping.prune_interval': 10, 'mapping.view_interval': 2}}
few |= EVERY_FRAME
sensor = replace(source.sensor, depth_bias=0.01, color_readout_ms=26.0)
config = override(Config(ablation={ablation!r}, sensor=sensor), few)
both = pipeline.start(source.camera, config, {mapping}, False, Workers(2))
before = compiled()
assert any(before.values())
results = []
for k in range(0, 30, 3):
    frame = source.render(k)
    results.append(both.tracker.track(frame))
    both.mapping.after(frame, results[-1])
    both.mapping.advance()
    both.closing.after(results[-1])
    both.closing.advance()
both.tracker.correct(both.tracker.corrected_poses)
both.tracker.interrupt()
for k in (30, 33):
    both.tracker.track(replace(frame, stamp_ns=k * 10**9, depth_stamp_ns=k * 10**9))
both.closing.finish()
for left in both.mapping.finish():
    pass
assert sum(result.keyframe for result in results) >= 2, [r.keyframe for r in results]
after = compiled()
assert before == after, {{key: after[key] for key in after if after[key] != before.get(key)}}
"""


@pytest.mark.slow
@pytest.mark.parametrize(('ablation', 'mapping'), [('full', True), ('shared', False)])
def test_a_run_compiles_nothing_that_the_warm_up_did_not(ablation: str, mapping: bool) -> None:
    done = subprocess.run(
        [sys.executable, '-c', CODE.format(ablation=ablation, mapping=mapping)],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
