# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Small random scenes for renderers, each with one kind of difficulty in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.render.renderer import NEAR_M, View

COUNT = 60
XI = np.array([0.4, -0.7, 0.3, 0.5, -1.1, 0.8])  # of the camera
MEANS, SCALES, QUATS, OPACITY = slice(0, 3), slice(3, 6), slice(6, 10), 10  # planes


class Scene(NamedTuple):
    planes: NDArray[np.float32]  # (14, N)
    view: View


class Draft(NamedTuple):
    """What a scene is made of; the means are still in the camera frame."""

    rng: np.random.Generator
    view: View
    planes: NDArray[np.float64]


def pixel_m(draft: Draft) -> NDArray[np.float64]:
    """Width of a pixel at each mean's depth."""
    width: NDArray[np.float64] = np.abs(draft.planes[2]) / draft.view.fx
    return width


def place(
    draft: Draft, x: NDArray[np.floating], y: NDArray[np.floating], which: slice = slice(None)
) -> None:
    """Move means to these pixels, at the depths they have."""
    view, p = draft.view, draft.planes
    z = p[2, which]
    p[0, which], p[1, which] = (x - view.cx) / view.fx * z, (y - view.cy) / view.fy * z


def ordinary(draft: Draft) -> None:
    pass


def tiny(draft: Draft) -> None:
    draft.planes[SCALES] = np.log(draft.rng.uniform(1e-4, 0.3, (3, COUNT)) * pixel_m(draft))


def huge(draft: Draft) -> None:
    draft.planes[SCALES] = np.log(draft.rng.uniform(20, 200, (3, COUNT)) * pixel_m(draft))
    draft.planes[OPACITY] -= 2.0


def behind(draft: Draft) -> None:
    draft.planes[2, ::2] *= -1.0


def near(draft: Draft) -> None:
    """Just before and just behind NEAR_M, but not where float32 decides."""
    x, y = draft.rng.uniform(0, 1, (2, COUNT)) * [[draft.view.width], [draft.view.height]]
    sides = draft.rng.choice([-1.0, 1.0], COUNT)
    draft.planes[2] = NEAR_M * (1.0 + sides * 10.0 ** draft.rng.uniform(-3.5, -0.5, COUNT))
    place(draft, x, y)
    draft.planes[SCALES] = np.log(draft.rng.uniform(1, 6, (3, COUNT)) * pixel_m(draft))


def border(draft: Draft) -> None:
    """On the border, beyond it, and so far out that the Jacobian is clamped."""
    w, h = draft.view.width, draft.view.height
    along = draft.rng.uniform(-0.2, 1.2, COUNT)
    outside = draft.rng.choice([-0.8, -0.2, -0.05, 0.0, 1.0, 1.05, 1.2, 1.8], COUNT)
    outside += draft.rng.uniform(-0.04, 0.04, COUNT)
    swap = draft.rng.uniform(size=COUNT) < 0.5
    place(draft, np.where(swap, along, outside) * w, np.where(swap, outside, along) * h)
    draft.planes[SCALES] = np.log(draft.rng.uniform(2, 25, (3, COUNT)) * pixel_m(draft))


def transparent(draft: Draft) -> None:
    """Opacities around ALPHA_MIN, and almost none."""
    draft.planes[OPACITY] = draft.rng.uniform(-8.0, -4.0, COUNT)


def opaque(draft: Draft) -> None:
    """Opacities above ALPHA_MAX, where alpha has no gradient."""
    draft.planes[OPACITY] = draft.rng.uniform(4.0, 14.0, COUNT)


def saturated(draft: Draft) -> None:
    """Layer upon layer: every pixel ends."""
    draft.planes[SCALES] = np.log(draft.rng.uniform(10, 40, (3, COUNT)) * pixel_m(draft))
    draft.planes[OPACITY] = draft.rng.uniform(0.0, 5.0, COUNT)


def needles(draft: Draft) -> None:
    """A hundred times as long as wide, and flat ones."""
    thin = draft.rng.uniform(0.02, 0.3, (3, COUNT))
    thin[0] = draft.rng.uniform(5, 30, COUNT)
    thin[1, ::2] = draft.rng.uniform(5, 30, COUNT // 2)
    draft.planes[SCALES] = np.log(thin * pixel_m(draft))


def unnormalised(draft: Draft) -> None:
    draft.planes[QUATS] *= 10.0 ** draft.rng.uniform(-3, 3, COUNT)


def inside(draft: Draft) -> None:
    """Larger than they are far away: the camera is in the midst of them."""
    draft.planes[MEANS] = draft.rng.uniform(-0.4, 0.4, (3, COUNT))
    draft.planes[2] = draft.rng.uniform(0.06, 0.5, COUNT)
    draft.planes[SCALES] = np.log(draft.rng.uniform(0.1, 1.0, (3, COUNT)))
    draft.planes[OPACITY] -= 3.0


DIFFICULTIES: dict[str, Callable[[Draft], None]] = {
    f.__name__: f
    for f in (
        ordinary, tiny, huge, behind, near, border, transparent, opaque, saturated, needles,
        unnormalised, inside,
    )
}  # fmt: skip
SIZES = ((37, 53), (64, 48), (16, 97), (5, 3))  # none a multiple of 32 both ways
NAMES = (*DIFFICULTIES, 'equal_depths', 'one', 'not_finite', 'none')


def scene(name: str, seed: int) -> Scene:
    """Make the scene of this name: the camera off centre, its axes unequal, not at the origin."""
    rng = np.random.default_rng(seed)
    width, height = SIZES[seed % len(SIZES)]
    focal = max(width, height)
    # Equal depths stay equal in any precision only where nothing is turned.
    T = se3.exp(XI * (1, 1, 1, 0, 0, 0) if name == 'equal_depths' else XI)
    view = View(
        width, height, fx=0.9 * focal, fy=1.2 * focal, cx=0.4 * width, cy=0.55 * height,
        T_world_cam=T,
    )  # fmt: skip
    planes = np.empty((14, COUNT))
    draft = Draft(rng, view, planes)
    planes[2] = rng.uniform(0.5, 4.0, COUNT)
    place(draft, *(rng.uniform(-0.1, 1.1, (2, COUNT)) * [[width], [height]]))
    planes[SCALES] = np.log(rng.uniform(0.5, 8.0, (3, COUNT)) * pixel_m(draft))
    planes[QUATS] = rng.normal(size=(4, COUNT))
    planes[OPACITY:] = rng.normal(scale=1.5, size=(4, COUNT))
    DIFFICULTIES.get(name, ordinary)(draft)
    if name == 'equal_depths':
        planes[2] = rng.choice([1.0, 2.0], COUNT)
    planes[MEANS] = T[:3, :3] @ planes[MEANS] + T[:3, 3:]
    if name == 'one':
        planes = planes[:, :1]
    if name == 'none':
        planes = planes[:, :0]
    if name == 'not_finite':
        planes[rng.integers(14, size=20), np.arange(20)] = rng.choice([np.nan, np.inf], 20)
    return Scene(planes.astype(np.float32), view)
