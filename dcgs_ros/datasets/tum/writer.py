# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A sequence as a folder in TUM's layout: PNGs, two lists of them, the truth, the camera."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.frame import RgbdFrame
from ...io.trajectory import format_stamp_ns, write_tum
from ..bag.writing.frames import encode_image
from ..cameras import TUM_DEPTH_PER_METRE
from ..described import write_description
from ..source import Source

_LARGEST = 65535  # of 16 bits


@dataclass
class _Lost:
    """Pixels of depth that a raw value does not tell."""

    rounded: int = 0
    too_far: int = 0

    def lines(self) -> list[str]:
        step_mm, end_m = 1e3 / TUM_DEPTH_PER_METRE, _LARGEST / TUM_DEPTH_PER_METRE
        told = (
            (self.rounded, f'rounded to {step_mm:g} mm'),
            (self.too_far, f'beyond {end_m:.2f} m left out'),
        )
        return [f'depth of {pixels} pixels was {what}' for pixels, what in told if pixels]


def write_tum_folder(folder: Path, source: Source, frames: Iterable[RgbdFrame]) -> list[str]:
    """Write these frames of the source into a new folder, with its poses and its camera.

    Images are named by their stamps in seconds with nine decimals, depth is 5000 per metre, the
    camera and its noise are in `dcgs.yaml`. Returns what was lost, a line each; raises `OSError`.
    """
    lost = _Lost()
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


def _raw_depth(depth_m: NDArray[np.float32], lost: _Lost) -> NDArray[np.uint16]:
    """Depth (H, W) in metres as a raw image has it; 0 where there is none or it is too far."""
    per_metre = np.float32(TUM_DEPTH_PER_METRE)
    values = np.rint(depth_m * per_metre)
    too_far = values > _LARGEST
    raw = np.where(too_far, 0, values).astype(np.uint16)
    lost.too_far += int(too_far.sum())
    lost.rounded += int((~too_far & (raw / per_metre != depth_m)).sum())
    return raw


def _write_png(folder: Path, kind: str, stamp_ns: int, pixels: NDArray) -> str:
    """Write an image; returns its line of the list."""
    stamp = format_stamp_ns(stamp_ns)
    (folder / kind / f'{stamp}.png').write_bytes(encode_image('.png', pixels))
    return f'{stamp} {kind}/{stamp}.png\n'
