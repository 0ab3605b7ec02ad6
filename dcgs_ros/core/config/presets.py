# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Named choices: ablations, depth's registration, what `--quality` and `--online` change.

The command line's `--help` lists them, so this module imports nothing heavy.
"""

from __future__ import annotations

from typing import Literal

Ablation = Literal['full', 'sigma_t', 'shared', 'shared_klt']
Quality = Literal['draft', 'default', 'high']
RegistrationChoice = Literal['auto', 'none', 'extrinsics']  # of depth to colour

# With the mapper in its own thread the clock leaves fewer steps: fewer views share them, and more
# of them are at reduced resolution.
ONLINE: dict[str, float] = {'mapping.view_interval': 6, 'mapping.coarse_share': 0.8}

QUALITIES: dict[Quality, dict[str, float]] = {
    'draft': {'mapping.steps_per_frame': 1, 'mapping.final_steps': 100},
    'default': {},
    'high': {
        'mapping.steps_per_frame': 4,
        'mapping.final_steps': 6000,
        'mapping.spawn_stride_px': 3,
        'mapping.view_interval': 2,
        'mapping.exposure_share': 0.9,
    },
}
