# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Corners stand out of the image's noise, keep their distance, and are spread over the image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.config.stages import LandmarkConfig
from dcgs_ros.core.tracking.corners import _corners_at, corners, noise, spread

SHAPE = (240, 320)
CONFIG = LandmarkConfig()
HALF_RESOLUTION_PX = 2.0  # corners are found on every second pixel
NOISE_SHARE = 0.1  # of the noise, by which its estimate is off
NONE = np.empty((0, 2), np.float32)


def blocks(seed: int, low: int = 60, high: int = 200) -> NDArray[np.float64]:
    """Random grey blocks, slightly blurred: corners everywhere."""
    levels = np.random.default_rng(seed).integers(low, high, (SHAPE[0] // 16, SHAPE[1] // 16))
    image = np.kron(levels, np.ones((16, 16)))
    return np.asarray(cv2.GaussianBlur(image, (5, 5), 1.0), np.float64)


def photographed(scene: NDArray[np.float64], sigma: float, seed: int) -> NDArray[np.uint8]:
    """Add white noise, and round."""
    image = scene + np.random.default_rng(seed).normal(0, sigma, scene.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def found(
    grey: NDArray[np.uint8], wanted: int = 300, taken: NDArray[np.float32] = NONE
) -> NDArray[np.float32]:
    return corners(grey, taken, wanted, CONFIG)


def share_found_again(pixels: NDArray[np.float32], others: NDArray[np.float32]) -> float:
    gaps = np.linalg.norm(pixels[:, None] - others[None], axis=2)
    return float(np.mean(gaps.min(axis=1) <= 2 * HALF_RESOLUTION_PX))


@pytest.mark.parametrize('sigma', [1.0, 2.0, 5.0, 12.0])
@pytest.mark.parametrize('seed', [0, 1])
def test_noise_is_measured_beneath_texture(sigma: float, seed: int) -> None:
    """Edges take a small part of the image, the median does not see them."""
    flat = photographed(np.full(SHAPE, 120.0), sigma, seed)
    assert noise(flat) == pytest.approx(np.hypot(sigma, 12**-0.5), rel=NOISE_SHARE)
    assert noise(photographed(blocks(seed), sigma, seed)) == pytest.approx(sigma, rel=0.4)


def test_a_ramp_is_not_noise() -> None:
    ramp = np.tile(np.arange(SHAPE[1]) * 0.5, (SHAPE[0], 1))
    assert noise(photographed(ramp, 3.0, seed=2)) == pytest.approx(3.0, rel=NOISE_SHARE)


@pytest.mark.parametrize('seed', [3, 4])
def test_a_dim_image_has_the_corners_of_the_bright_one(seed: int) -> None:
    """A fifth of the contrast and of the noise: what stands out of one stands out of both."""
    scene = blocks(seed)
    bright, dim = photographed(scene, 5.0, seed), photographed(scene / 5.0, 1.0, seed)
    one, other = found(bright), found(dim)
    assert len(one) > 50
    assert len(other) == pytest.approx(len(one), rel=0.15)
    assert share_found_again(one, other) > 0.85 and share_found_again(other, one) > 0.85


@pytest.mark.parametrize('seed', [5, 6])
def test_in_the_noise_of_the_dark_only_strong_corners_are_left(seed: int) -> None:
    """The same contrast in more noise: fewer; never one that the noise makes."""
    scene = blocks(seed, 110, 140)
    counts = [len(found(photographed(scene, sigma, seed))) for sigma in (0.5, 2.0, 20.0)]
    assert counts[0] > 1.2 * counts[1] > counts[2] == 0


@pytest.mark.parametrize('sigma', [0.0, 0.2, 1.0, 5.0, 20.0])
@pytest.mark.parametrize('seed', [7, 8])
def test_noise_alone_has_no_corners(sigma: float, seed: int) -> None:
    assert len(found(photographed(np.full(SHAPE, 120.0), sigma, seed))) == 0


def test_corners_are_where_the_squares_have_theirs() -> None:
    """Black squares on white, at half pixels of half resolution."""
    image = np.full(SHAPE, 220, np.uint8)
    image[60:120, 80:160] = 20
    image[150:200, 220:280] = 20
    true = [
        (x - 0.5, y - 0.5)
        for left, right, top, bottom in ((80, 160, 60, 120), (220, 280, 150, 200))
        for x in (left, right)
        for y in (top, bottom)
    ]
    pixels = found(image, 20)
    assert len(pixels) == 8
    gaps = np.linalg.norm(pixels[:, None] - np.array(true)[None], axis=2)
    assert (gaps.min(axis=0) <= 1.5 * HALF_RESOLUTION_PX).all()


def test_corners_keep_their_distance_to_each_other_and_to_those_taken() -> None:
    grey = photographed(blocks(9), 1.0, seed=9)
    everything = found(grey)
    taken = everything[::3]
    new = found(grey, taken=taken)
    assert len(new) > 50
    least = CONFIG.min_distance_px - 2 * HALF_RESOLUTION_PX
    assert np.linalg.norm(new[:, None] - taken[None], axis=2).min() >= least
    apart = np.linalg.norm(new[:, None] - new[None], axis=2)
    assert apart[~np.eye(len(new), dtype=bool)].min() >= least


def test_as_many_are_returned_as_are_wanted() -> None:
    grey = photographed(blocks(10), 1.0, seed=10)
    best = found(grey, 40)
    assert len(best) == 40
    np.testing.assert_array_equal(best, found(grey, 300)[:40])
    for wanted in (0, -5):
        assert found(grey, wanted).shape == (0, 2)


def test_a_textured_quarter_does_not_take_all() -> None:
    """Three quarters have a third of the contrast, and as many corners a cell all the same."""
    scene = 120.0 + (blocks(11, 60, 180) - 120.0) / 3.0
    scene[:120, :160] = blocks(12, 0, 255)[:120, :160]
    pixels = found(photographed(scene, 1.0, seed=11), 48)
    cells = spread(pixels, SHAPE)
    assert cells.max() <= 2 and np.count_nonzero(cells) > 40
    quarter = np.count_nonzero((pixels < (160, 120)).all(axis=1))
    assert quarter <= 20


def test_the_best_of_each_cell_come_first() -> None:
    """Contrast falls from left to right within each cell of 40 pixels: the left ones."""
    scene = np.full(SHAPE, 100.0)
    for y in range(8, 240, 40):
        for x in range(4, 320, 40):
            scene[y : y + 12, x : x + 10] += 100.0
            scene[y : y + 12, x + 20 : x + 30] += 50.0
    pixels = found(photographed(scene, 1.0, seed=13), 48)
    assert (spread(pixels, SHAPE) == 1).all()
    assert (pixels[:, 0] % 40 < 17).all()


@pytest.mark.parametrize('seed', [14, 15])
def test_motion_blur_leaves_corners_of_coarse_texture(seed: int) -> None:
    """Where few corners are found at half resolution a quarter shows more, with less noise."""
    scene = cv2.blur(blocks(seed, 100, 150), (11, 1))
    grey = photographed(scene, 3.0, seed)
    fine, both = _corners_at(grey, 2, NONE, CONFIG), found(grey)
    assert len(fine) < 20 < 40 < len(both)
    np.testing.assert_array_equal(both[: len(fine)], fine)
    least = CONFIG.min_distance_px - 2 * HALF_RESOLUTION_PX
    apart = np.linalg.norm(both[:, None] - both[None], axis=2)
    assert apart[~np.eye(len(both), dtype=bool)].min() >= least
    few = found(grey, wanted=len(fine) + 1)  # enough: the coarse ones are not looked for
    np.testing.assert_array_equal(few, fine)


def test_spread_counts_the_pixels_of_each_cell() -> None:
    pixels = np.array([[0, 0], [39.4, 39.4], [40.1, 0], [319.4, 239.4], [-0.4, 300.0]], np.float32)
    cells = spread(pixels, SHAPE).reshape(6, 8)
    assert cells.sum() == 5
    assert (cells[0, 0], cells[0, 1], cells[5, 7], cells[5, 0]) == (2, 1, 1, 1)
    assert spread(NONE, SHAPE).tolist() == [0] * 48
