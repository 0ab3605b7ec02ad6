# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The Gaussians and keyframes of a mapper as rows of clouds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.mapping.mapper import Mapper
from ...core.mapping.splats import SH_C0
from ...core.mapping.views import KeyframeView
from ...io.snapshot import as_hosts_saw
from .clouds import KEYFRAME_POSE, MAP_GAUSSIAN, pack_rgb

_ELEMENTS = ('xx', 'xy', 'xz', 'yy', 'yz', 'zz')


def map_rows(mapper: Mapper) -> NDArray[Any]:
    """Return all finite Gaussians as MAP_GAUSSIAN rows (N,) in ascending order of id."""
    table = mapper.table
    order = np.argsort(table.ids)
    with np.errstate(invalid='ignore', over='ignore'):
        scales = np.exp(table.splats.log_scales[:, order])
        quats = table.splats.quats_wxyz[:, order].astype(np.float64)
        quats /= np.linalg.norm(quats, axis=0)
        opacities = 1.0 / (1.0 + np.exp(-table.splats.opacity_logits[order]))
    finite = np.isfinite(table.splats.planes[:, order]).all(axis=0)
    finite &= np.isfinite(scales).all(axis=0) & np.isfinite(quats).all(axis=0)
    order, scales, quats = order[finite], scales[:, finite], quats[:, finite]
    planes = table.splats.planes[:, order]
    rows = np.zeros(len(order), MAP_GAUSSIAN)
    rows['id'] = table.ids[order]
    for k, axis in enumerate('xyz'):
        rows[axis] = planes[k]
        rows[f'scale_{k}'] = scales[k]
    for k in range(4):
        rows[f'rot_{k}'] = quats[k]
    rows['opacity'] = opacities[finite]
    colors = (0.5 + SH_C0 * planes[11:14].T).clip(0.0, 1.0)
    rows['rgb'] = pack_rgb(np.rint(255.0 * colors).astype(np.uint8))
    rows['keyframe'] = table.hosts[order]
    covariances = as_hosts_saw(mapper)[1][order]
    for k, element in enumerate(_ELEMENTS):
        rows[f'track_cov_{element}'] = covariances[:, k]
    return rows


def keyframe_rows(views: Sequence[KeyframeView], submaps: Sequence[int]) -> NDArray[Any]:
    """Return stamps, sub-maps and refined poses as KEYFRAME_POSE rows (N,).

    A row's number is the view's index.
    """
    rows = np.zeros(len(views), KEYFRAME_POSE)
    for k, (view, submap) in enumerate(zip(views, submaps, strict=True)):
        w, x, y, z = se3.to_quaternion(view.T_world_cam)
        stamp = divmod(view.stamp_ns, 1_000_000_000)
        rows[k] = (*stamp, *view.T_world_cam[:3, 3], x, y, z, w, submap)
    return rows
