# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""One RGB-D measurement, as it comes from a camera or a file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import FrameError


@dataclass(frozen=True)
class RgbdFrame:
    """Colour and depth of one camera, depth registered to colour, each with its own stamp.

    Raises `FrameError` for arrays that do not form an RGB-D frame.
    """

    stamp_ns: int  # of the colour image: the instant a pose refers to
    depth_stamp_ns: int
    color: NDArray[np.uint8]  # (H, W, 3) RGB or (H, W) grey
    depth_m: NDArray[np.float32]  # (H, W), 0 = no measurement

    def __post_init__(self) -> None:
        """Check shapes and types, and that some pixel has depth."""
        shape = self.color.shape
        if self.color.dtype != np.uint8 or len(shape) not in (2, 3) or shape[2:] not in ((), (3,)):
            raise FrameError(
                f'colour is {self.color.dtype} {shape}, not uint8 (H, W, 3) or (H, W)'
            )
        if self.depth_m.dtype != np.float32 or self.depth_m.ndim != 2:
            raise FrameError(
                f'depth is {self.depth_m.dtype} {self.depth_m.shape}, not float32 (H, W)'
            )
        if self.color.shape[:2] != self.depth_m.shape:
            height, width = self.color.shape[:2]
            raise FrameError(
                f'colour is {width}x{height} but depth {self.depth_m.shape[1]}x'
                f'{self.depth_m.shape[0]} pixels'
            )
        if not np.any(self.depth_m > 0):
            raise FrameError('depth is zero everywhere')
