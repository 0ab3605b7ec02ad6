# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Groups of settings: `--online` and `--quality`."""

from __future__ import annotations

# With `--online` the mapper has time for fewer steps: they are spent on fewer views, and more of
# them are coarse.
ONLINE: dict[str, float] = {'mapping.view_interval': 6, 'mapping.coarse_share': 0.8}

QUALITIES: dict[str, dict[str, float]] = {
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
