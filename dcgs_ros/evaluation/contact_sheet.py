# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A PNG that shows rendered views beside the camera's images."""

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
MARGIN_PX = 5  # left of, right of and below each image
TITLE_PX = 24  # above each image
_FONT, _FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.45
_BACKGROUND, _TEXT = (255, 255, 255), (40, 40, 40)


class ContactSheetError(DcgsError):
    """A contact sheet cannot be drawn or written."""


@dataclass(frozen=True)
class ContactPair:
    """A rendered view and the camera's image of it."""

    title: str  # ASCII
    rendered: NDArray[np.float32]  # (H, W, 3) RGB, clipped to 0 to 1
    real: NDArray[np.float32]  # the same


def write_contact_sheet(path: Path | str, pairs: Sequence[ContactPair]) -> None:
    """Write a PNG with one row per pair, of at most `MAX_ROWS` pairs spread evenly.

    Raises `ContactSheetError` if there are no pairs, shapes differ, or `path` cannot be written.
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
    """Return the rendered view and the image side by side, (H, W, 3) RGB."""
    return np.hstack(
        [_panel(pair.rendered, f'rendered   {pair.title}'), _panel(pair.real, 'real')]
    )


def _panel(image: NDArray[np.float32], text: str) -> NDArray[np.uint8]:
    """Return an image, at most `MAX_WIDTH_PX` wide, with margins and a line of text above."""
    image = np.clip(image, 0, 1)
    height, width = image.shape[:2]
    if width > MAX_WIDTH_PX:
        size = (MAX_WIDTH_PX, max(round(height * MAX_WIDTH_PX / width), 1))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    panel = cv2.copyMakeBorder(
        np.round(255 * image).astype(np.uint8), TITLE_PX, MARGIN_PX, MARGIN_PX, MARGIN_PX,
        cv2.BORDER_CONSTANT, value=_BACKGROUND,
    )  # fmt: skip
    baseline = (MARGIN_PX, TITLE_PX - 8)
    return cv2.putText(panel, text, baseline, _FONT, _FONT_SCALE, _TEXT, 1, cv2.LINE_AA)
