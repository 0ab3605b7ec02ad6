# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A picture that sets rendered beside real views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import DcgsError

MAX_ROWS = 4
MAX_WIDTH_PX = 480  # of one image
MARGIN_PX = 5  # around each image
TITLE_PX = 24  # above it, instead
_FONT, _FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.45
_PAPER, _INK = (255, 255, 255), (40, 40, 40)


class ContactSheetError(DcgsError):
    """A contact sheet cannot be made."""


@dataclass(frozen=True)
class ContactPair:
    """A view as it was rendered and as the camera saw it."""

    title: str  # ASCII
    rendered: NDArray[np.float32]  # (H, W, 3) RGB, clipped to 0 to 1
    real: NDArray[np.float32]  # the same


def write_contact_sheet(path: Path | str, pairs: Sequence[ContactPair]) -> None:
    """Write a PNG with a row for each pair; of more than `MAX_ROWS`, as many evenly spread.

    Raises `ContactSheetError` without pairs, where shapes differ or `path` cannot be written.
    """
    shapes = {image.shape for pair in pairs for image in (pair.rendered, pair.real)}
    if len(shapes) != 1 or [shape[2:] for shape in shapes] != [(3,)]:
        raise ContactSheetError(f'views are of {sorted(shapes)}, not of one shape (H, W, 3)')
    chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), MAX_ROWS)).round().astype(int)
    sheet = np.vstack([_row(pairs[k]) for k in chosen])
    _, data = cv2.imencode('.png', cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    try:
        Path(path).write_bytes(data.tobytes())
    except OSError as error:
        raise ContactSheetError(f'{path}: cannot be written: {error.strerror}') from error


def _row(pair: ContactPair) -> NDArray[np.uint8]:
    return np.hstack(
        [_panel(pair.rendered, f'rendered   {pair.title}'), _panel(pair.real, 'real')]
    )


def _panel(image: NDArray[np.float32], text: str) -> NDArray[np.uint8]:
    """Shrink an image to `MAX_WIDTH_PX` at most and set it on paper, under a line of text."""
    image = np.clip(image, 0, 1)
    height, width = image.shape[:2]
    if width > MAX_WIDTH_PX:
        size = (MAX_WIDTH_PX, max(round(height * MAX_WIDTH_PX / width), 1))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    panel = cv2.copyMakeBorder(
        np.round(255 * image).astype(np.uint8), TITLE_PX, MARGIN_PX, MARGIN_PX, MARGIN_PX,
        cv2.BORDER_CONSTANT, value=_PAPER,
    )  # fmt: skip
    baseline = (MARGIN_PX, TITLE_PX - 8)
    return cv2.putText(panel, text, baseline, _FONT, _FONT_SCALE, _INK, 1, cv2.LINE_AA)
