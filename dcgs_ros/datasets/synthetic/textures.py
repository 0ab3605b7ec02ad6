# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Procedural, seamless, mip-mapped textures of the scenes' surfaces."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

TEXTURE_SIZE = 1024  # texels, a power of two
MIP_LEVELS = 8


class Textures(NamedTuple):
    """All textures and their mip levels in one array."""

    texels: NDArray[np.uint32]  # (M,) r + 256 g + 65536 b, row-major, one level after the other
    starts: NDArray[np.int64]  # (textures, MIP_LEVELS) index of each level's first texel
    size: int  # texels, of the first level


def _clouds(
    rng: np.random.Generator, cells: tuple[int, int], channels: int = 1
) -> NDArray[np.float32]:
    """Return smooth, wrapped noise (S, S, channels) of unit amplitude; `cells` (rows, columns)."""
    coarse = rng.standard_normal((*cells, channels)).astype(np.float32)
    coarse = np.pad(coarse, ((2, 2), (2, 2), (0, 0)), mode='wrap')
    step_y, step_x = TEXTURE_SIZE // cells[0], TEXTURE_SIZE // cells[1]
    size = (coarse.shape[1] * step_x, coarse.shape[0] * step_y)
    fine = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
    fine = fine.reshape(size[1], size[0], channels)
    return fine[2 * step_y : -2 * step_y, 2 * step_x : -2 * step_x]


def _ink(rng: np.random.Generator, low: float = 10, high: float = 245) -> NDArray[np.float64]:
    """Return a random RGB colour (3,), mostly of low saturation."""
    return np.clip(rng.uniform(low, high) + rng.uniform(20, 70) * rng.uniform(-1, 1, 3), 0, 255)


def _shapes(
    image: NDArray[np.floating], rng: np.random.Generator, count: int, largest: float
) -> None:
    """Draw filled rectangles and discs of random colour, cut off at the image's sides."""
    for _ in range(count):
        x, y = rng.integers(0, TEXTURE_SIZE, 2).tolist()
        color = _ink(rng).tolist()
        extent = largest * rng.uniform(0.1, 1.0, 2) ** 1.5
        if rng.random() < 0.2:
            cv2.circle(image, (x, y), int(extent[0] / 2) + 2, color, -1, cv2.LINE_AA)
            continue
        angle = float(rng.choice([0.0, 0.0, rng.uniform(0, 90)]))
        box = cv2.boxPoints(((x, y), (float(extent[0]) + 4, float(extent[1]) + 4), angle))
        cv2.fillConvexPoly(image, box.astype(np.int32), color, cv2.LINE_AA)


def _letters(image: NDArray[np.float32], rng: np.random.Generator, count: int, dot: int) -> None:
    """Draw short words of random letters, 5x7 dots of about `dot` texels each."""
    for _ in range(count):
        letters, size = int(rng.integers(1, 6)), max(2, round(dot * rng.uniform(0.5, 1.6)))
        ink = rng.random((7, 6 * letters)) < 0.55
        ink[:, 5::6] = False
        ink = ink.repeat(size, 0).repeat(size, 1)
        x, y = rng.integers(0, TEXTURE_SIZE, 2)
        patch = image[y : y + ink.shape[0], x : x + ink.shape[1]]
        patch[ink[: patch.shape[0], : patch.shape[1]]] = _ink(rng)


def _blank(level: float) -> NDArray[np.float32]:
    return np.full((TEXTURE_SIZE, TEXTURE_SIZE, 3), level, np.float32)


def _poster(rng: np.random.Generator) -> NDArray[np.floating]:
    image = np.ascontiguousarray(_blank(150) + 25 * _clouds(rng, (8, 8), 3))
    _shapes(image, rng, 170, 190)
    _letters(image, rng, 90, 6)
    return image


def _books(rng: np.random.Generator) -> NDArray[np.floating]:
    """Rows of book spines on dark shelves."""
    image = _blank(45)
    rows = 4
    for row in range(rows):
        x, foot = 0, (row + 1) * TEXTURE_SIZE // rows - 14
        while x < TEXTURE_SIZE:
            width = int(rng.integers(14, 46))
            top = foot - int(rng.integers(150, 225))
            color = _ink(rng, 20, 225)
            cv2.rectangle(image, (x, top), (x + width - 3, foot), color.tolist(), -1)
            for share in rng.uniform(0.1, 0.9, 3):
                y, tall = int(top + share * (foot - top)), int(rng.integers(3, 16))
                mark = _ink(rng).tolist()
                cv2.rectangle(image, (x + 4, y), (x + width - 7, y + tall), mark, -1)
            x += width
    return image


def _wood(rng: np.random.Generator) -> NDArray[np.floating]:
    grain = 14 * _clouds(rng, (512, 4)) + 9 * _clouds(rng, (64, 8)) + 6 * _clouds(rng, (256, 256))
    image = np.ascontiguousarray(np.array([168, 132, 96], np.float32) + grain)
    for x, y in rng.integers(0, TEXTURE_SIZE, (26, 2)).tolist():  # knots and stains
        axes = (int(rng.integers(4, 16)), int(rng.integers(3, 9)))
        shade = (np.array([92.0, 66.0, 44.0]) * rng.uniform(0.7, 1.6)).tolist()
        cv2.ellipse(image, (x, y), axes, 0, 0, 360, shade, -1, cv2.LINE_AA)
    return image


def _carpet(rng: np.random.Generator) -> NDArray[np.floating]:
    """Speckled floor tiles of slightly different shades."""
    image = np.repeat(np.repeat(rng.uniform(95, 175, (8, 8, 1)), 128, 0), 128, 1)
    image = image * rng.uniform(0.92, 1.08, (1, 1, 3)) + 10 * _clouds(rng, (128, 128))
    image = np.ascontiguousarray(image, np.float32)
    for k in range(0, TEXTURE_SIZE, 128):
        image[k : k + 4] = image[:, k : k + 4] = 60
    _shapes(image, rng, 200, 26)
    return image


def _plaster(rng: np.random.Generator) -> NDArray[np.floating]:
    return _blank(200) + 1.6 * _clouds(rng, (256, 256)) + 3 * _clouds(rng, (8, 8))


def _print(rng: np.random.Generator) -> NDArray[np.floating]:
    """Pages of text and small figures."""
    image = np.ascontiguousarray(_blank(215) + 6 * _clouds(rng, (32, 32)))
    _shapes(image, rng, 60, 130)
    _letters(image, rng, 420, 3)
    return image


def _keys(rng: np.random.Generator) -> NDArray[np.floating]:
    """Rows of keys, buttons and labels on a dark ground."""
    image = _blank(50)
    for y in range(0, TEXTURE_SIZE, 64):
        for x in range(0, TEXTURE_SIZE, 64):
            color = (rng.uniform(60, 230) * rng.uniform(0.85, 1.0, 3)).tolist()
            cv2.rectangle(image, (x + 7, y + 7), (x + 56, y + 56), color, -1)
    _letters(image, rng, 180, 4)
    return image


def _tiles(rng: np.random.Generator) -> NDArray[np.floating]:
    """Two by two floor tiles, nearly alike, with joints."""
    image = _blank(160) + 3 * _clouds(rng, (16, 16)) + 3 * _clouds(rng, (128, 128))
    image *= np.repeat(np.repeat(rng.uniform(0.96, 1.04, (2, 2, 1)), 512, 0), 512, 1)
    for k in (0, 512):
        image[k : k + 9] = image[:, k : k + 9] = 105
    return image


_MAKERS: dict[str, Callable[[np.random.Generator], NDArray[np.floating]]] = {
    'poster': _poster,
    'books': _books,
    'wood': _wood,
    'carpet': _carpet,
    'plaster': _plaster,
    'print': _print,
    'keys': _keys,
    'tiles': _tiles,
}
TEXTURE_NAMES = tuple(_MAKERS)


@lru_cache(maxsize=1)
def build_textures() -> Textures:
    """Draw all textures, identical in every process; about 45 MB."""
    sizes = [TEXTURE_SIZE >> level for level in range(MIP_LEVELS)]
    ends = np.cumsum([size * size for _ in _MAKERS for size in sizes])
    starts = np.concatenate([[0], ends[:-1]]).reshape(len(_MAKERS), MIP_LEVELS)
    texels = np.empty(ends[-1], np.uint32)
    for k, maker in enumerate(_MAKERS.values()):
        image = np.clip(maker(np.random.default_rng(k)), 0, 255)
        for start, size in zip(starts[k], sizes, strict=True):
            red, green, blue = np.moveaxis(np.round(image).astype(np.uint32), -1, 0)
            texels[start : start + size * size] = (red | green << 8 | blue << 16).ravel()
            image = image.reshape(size // 2, 2, size // 2, 2, 3).mean(axis=(1, 3))
    return Textures(texels, starts, TEXTURE_SIZE)
