# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A contact sheet shows the views it was given, with their titles."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.evaluation.contact_sheet import (
    MARGIN_PX,
    MAX_ROWS,
    MAX_WIDTH_PX,
    TITLE_PX,
    ContactPair,
    ContactSheetError,
    write_contact_sheet,
)

HALF_GREY_LEVEL = 0.5 / 255 + 1e-6


def plain(red: float, shape: tuple[int, int] = (60, 80)) -> NDArray[np.float32]:
    image = np.zeros((*shape, 3), np.float32)
    image[:] = (red, 0.25, 1.0)
    return image


def pair(k: int, shape: tuple[int, int] = (60, 80)) -> ContactPair:
    return ContactPair(f'frame {k}', plain(0.1 * k, shape), plain(0.05 + 0.1 * k, shape))


def sheet(path: Path, pairs: list[ContactPair]) -> NDArray[np.uint8]:
    """Write a sheet and read it back as RGB."""
    write_contact_sheet(path, pairs)
    image = cv2.imread(str(path))
    assert image is not None
    return image[..., ::-1]


def panel(
    image: NDArray[np.uint8], row: int, column: int, shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Cut one view out of a sheet, 0 to 1."""
    top = row * (TITLE_PX + shape[0] + MARGIN_PX) + TITLE_PX
    left = column * (shape[1] + 2 * MARGIN_PX) + MARGIN_PX
    return image[top : top + shape[0], left : left + shape[1]] / 255.0


def test_a_row_is_rendered_beside_real(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pairs = [
        ContactPair(f'{k}', *(rng.random((60, 80, 3), dtype=np.float32) for _ in range(2)))
        for k in range(3)
    ]
    image = sheet(tmp_path / 'a.png', pairs)
    for row, views in enumerate(pairs):
        for column, view in enumerate((views.rendered, views.real)):
            shown = panel(image, row, column, (60, 80))
            np.testing.assert_allclose(shown, view, atol=HALF_GREY_LEVEL)


def test_each_view_has_a_line_of_text_above_it(tmp_path: Path) -> None:
    image = sheet(tmp_path / 'a.png', [pair(0, (120, 200)), pair(1, (120, 200))])
    for top in (0, TITLE_PX + 120 + MARGIN_PX):
        text = image[top : top + TITLE_PX]
        for column in np.hsplit(text, 2):
            assert column.min() < 100
            assert np.all(column[[0, -1]] == 255)
    other = sheet(tmp_path / 'b.png', [pair(2, (120, 200)), pair(1, (120, 200))])
    assert np.any(other[:TITLE_PX] != image[:TITLE_PX])


def test_a_long_title_stays_above_its_own_view(tmp_path: Path) -> None:
    untitled, titled = (
        sheet(tmp_path / 'a.png', [ContactPair(title, plain(0.5), plain(0.5))])
        for title in ('', 'W' * 200)
    )
    np.testing.assert_array_equal(np.hsplit(titled, 2)[1], np.hsplit(untitled, 2)[1])


@pytest.mark.parametrize('shape', [(480, 640), (720, 1280), (1, 2000)])
def test_wide_views_are_shrunk_in_proportion(tmp_path: Path, shape: tuple[int, int]) -> None:
    image = sheet(tmp_path / 'a.png', [pair(3, shape)])
    height = max(round(shape[0] * MAX_WIDTH_PX / shape[1]), 1)
    assert image.shape == (TITLE_PX + height + MARGIN_PX, 2 * (MAX_WIDTH_PX + 2 * MARGIN_PX), 3)
    shown = panel(image, 0, 0, (height, MAX_WIDTH_PX))
    np.testing.assert_allclose(shown, plain(0.3, shown.shape[:2]), atol=HALF_GREY_LEVEL)


def test_of_many_views_a_few_are_shown_from_first_to_last(tmp_path: Path) -> None:
    image = sheet(tmp_path / 'a.png', [pair(k) for k in range(10)])
    reds = [panel(image, row, 0, (60, 80))[30, 40, 0] for row in range(MAX_ROWS)]
    assert len(image) == MAX_ROWS * (TITLE_PX + 60 + MARGIN_PX)
    np.testing.assert_allclose(reds, [0.0, 0.3, 0.6, 0.9], atol=HALF_GREY_LEVEL)


def test_colors_are_clipped_before_they_are_mixed(tmp_path: Path) -> None:
    rendered = np.zeros((480, 2 * MAX_WIDTH_PX, 3), np.float32)
    rendered[:, ::2] = 9.0
    image = sheet(tmp_path / 'a.png', [ContactPair('', rendered, rendered)])
    shown = panel(image, 0, 0, (240, MAX_WIDTH_PX))
    np.testing.assert_allclose(shown, 0.5, atol=HALF_GREY_LEVEL)


def test_errors_name_what_cannot_be_drawn_or_written(tmp_path: Path) -> None:
    path = tmp_path / 'a.png'
    with pytest.raises(ContactSheetError, match=r'views are of \[\], not'):
        write_contact_sheet(path, [])
    with pytest.raises(ContactSheetError, match=r'\(60, 80, 3\), \(61, 80, 3\)'):
        write_contact_sheet(path, [pair(0), pair(1, (61, 80))])
    planar = np.moveaxis(plain(0.5), 2, 0)
    with pytest.raises(ContactSheetError, match=r'\(3, 60, 80\)'):
        write_contact_sheet(path, [ContactPair('', planar, planar)])
    assert not path.exists()
    with pytest.raises(ContactSheetError, match='cannot be written: No such file'):
        write_contact_sheet(tmp_path / 'nowhere' / 'a.png', [pair(0)])
