# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Writing a sequence as a folder in TUM's layout: PNGs, their index files, truth and camera."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.frame import RgbdFrame
from ...io.trajectory import format_stamp_ns, write_tum
from ..bag.writing.frame_encoder import encode_image
from ..camera_presets import TUM_DEPTH_PER_METRE
from ..custom import write_description
from ..source import Source

_MAX_RAW = 65535


@dataclass
class _DepthLoss:
    """Numbers of pixels whose depth 16 bits do not hold exactly."""

    rounded: int = 0
    too_far: int = 0

    def lines(self) -> list[str]:
        step_mm, end_m = 1e3 / TUM_DEPTH_PER_METRE, _MAX_RAW / TUM_DEPTH_PER_METRE
        losses = (
            (self.rounded, f'rounded to {step_mm:g} mm'),
            (self.too_far, f'beyond {end_m:.2f} m left out'),
        )
        return [f'depth of {pixels} pixels was {what}' for pixels, what in losses if pixels]


def write_tum_folder(folder: Path, source: Source, frames: Iterable[RgbdFrame]) -> list[str]:
    """Write these frames of the source to a new folder, with the source's poses and camera.

    Images are named by their stamps in seconds with nine decimals, depth is 5000 per metre, the
    camera and its noise are in `dcgs.yaml`. Returns what was lost, one line each. Raises `OSError`
    or a `DcgsError` if a file cannot be written.
    """
    lost = _DepthLoss()
    for kind in ('rgb', 'depth'):
        (folder / kind).mkdir(parents=True)
    with (folder / 'rgb.txt').open('w') as colors, (folder / 'depth.txt').open('w') as depths:
        for file in (colors, depths):
            file.write('# timestamp filename\n')
        for frame in frames:
            raw = _raw_depth(frame.depth_m, lost)
            colors.write(_write_png(folder, 'rgb', frame.stamp_ns, frame.color))
            depths.write(_write_png(folder, 'depth', frame.depth_stamp_ns, raw))
    if source.groundtruth is not None:
        write_tum(folder / 'groundtruth.txt', source.groundtruth)
    write_description(folder, source.camera, source.sensor, TUM_DEPTH_PER_METRE)
    return lost.lines()


def _raw_depth(depth_m: NDArray[np.float32], lost: _DepthLoss) -> NDArray[np.uint16]:
    """Return depth (H, W), given in metres, as raw values; 0 for none and for too far."""
    per_metre = np.float32(TUM_DEPTH_PER_METRE)
    values = np.rint(depth_m * per_metre)
    too_far = values > _MAX_RAW
    raw = np.where(too_far, 0, values).astype(np.uint16)
    lost.too_far += int(too_far.sum())
    lost.rounded += int((~too_far & (raw / per_metre != depth_m)).sum())
    return raw


def _write_png(folder: Path, kind: str, stamp_ns: int, pixels: NDArray[Any]) -> str:
    """Write an image; returns its line of the index file."""
    stamp = format_stamp_ns(stamp_ns)
    (folder / kind / f'{stamp}.png').write_bytes(encode_image('.png', pixels))
    return f'{stamp} {kind}/{stamp}.png\n'
