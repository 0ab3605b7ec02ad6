# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What only the CPU renderer does: threads, tiles, order, limits, and invalid input."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from reference import doubtful, render  # type: ignore[import-not-found]
from scenes import scene  # type: ignore[import-not-found]
from scipy.spatial.transform import Rotation

from dcgs_ros.core import se3
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.mapping.splats import PLANES, SH_C0
from dcgs_ros.core.render import cpu
from dcgs_ros.core.render.cpu import CpuRenderer
from dcgs_ros.core.render.renderer import ALPHA_MAX, ALPHA_MIN, NEAR_M, T_MIN, RenderError, View

torch.set_num_threads(1)

IMAGE = 1e-4  # absolute, float32
CLOSED_FORM = 2e-5  # of one or of many Gaussians, float32
WEIGHTS = 1e-4  # relative
MARGIN = 1e-4  # relative: closer to a threshold float32 and float64 may disagree
TURNED = 2e-3  # relative L2: a turned world is rounded to other numbers


@pytest.fixture(scope='module')
def renderer() -> Iterator[CpuRenderer]:
    with closing(Workers(2)) as workers:
        yield CpuRenderer(workers)


def crowd(seed: int, count: int) -> NDArray[np.float32]:
    """Gaussians before a camera at the origin, of a few pixels."""
    rng = np.random.default_rng(seed)
    planes = rng.normal(size=(len(PLANES), count))
    planes[0:3] = rng.uniform((-1, -1, 1), (1, 1, 3), (count, 3)).T
    planes[3:6] = rng.uniform(-4, -2.5, (3, count))
    return planes.astype(np.float32)


def camera(width: int, height: int, T_world_cam: NDArray[np.float64] | None = None) -> View:
    focal = 0.8 * max(width, height)
    T = np.eye(4) if T_world_cam is None else T_world_cam
    return View(width, height, focal, focal, 0.5 * width - 0.5, 0.5 * height - 0.5, T)


def one(z: float, opacity: float, color: tuple[float, float, float]) -> NDArray[np.float32]:
    """A ball on the optical axis of a camera at the origin."""
    planes = np.zeros((len(PLANES), 1), np.float32)
    planes[2], planes[3:6], planes[6] = z, np.log(0.1), 1.0
    planes[10, 0] = np.log(opacity / (1 - opacity))
    planes[11:, 0] = (np.array(color) - 0.5) / SH_C0
    return planes


def everything(
    renderer: CpuRenderer, planes: NDArray[np.floating], view: View
) -> dict[str, NDArray[np.floating]]:
    """Render, and derive by a random upstream gradient; zeros where nothing is touched."""
    image = renderer.render(planes, view).planes.copy()
    upstream = np.random.default_rng(1).normal(size=image.shape).astype(np.float32)
    gradients = renderer.backward(upstream)
    return {
        'image': image,
        'planes': np.where(gradients.touched, gradients.planes, 0),
        'touched': gradients.touched.copy(),
        'pose': gradients.pose.copy(),
        'weights': gradients.weights.copy(),
    }


def assert_same(
    found: dict[str, NDArray[np.floating]], expected: dict[str, NDArray[np.floating]]
) -> None:
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_bytes_do_not_depend_on_the_number_of_threads() -> None:
    planes, view = crowd(0, 3000), camera(150, 70)
    found = []
    for threads in (1, 2, 3):
        with closing(Workers(threads)) as workers:
            found.append(everything(CpuRenderer(workers), planes, view))
    assert_same(found[1], found[0])
    assert_same(found[2], found[0])
    assert found[0]['touched'].any()


@pytest.mark.parametrize('count', [1, 15, 16, 17, 33])
def test_any_number_of_gaussians_is_what_it_is_among_transparent_ones(
    renderer: CpuRenderer, count: int
) -> None:
    planes, view = crowd(1, 64), camera(64, 48)
    alone = everything(renderer, planes[:, :count], view)
    planes[10, count:] = -100.0
    among = everything(renderer, planes, view)
    assert_same(alone, {name: values for name, values in among.items() if name == 'image'})
    for name in ('planes', 'touched', 'weights'):
        np.testing.assert_array_equal(alone[name], among[name][..., :count])
        assert not among[name][..., count:].any()
    # Other pieces of the work sum up others, in another order.
    np.testing.assert_allclose(alone['pose'], among['pose'], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize('size', [(1, 1), (33, 65)])
def test_an_empty_map_lets_everything_shine_through(
    renderer: CpuRenderer, size: tuple[int, int]
) -> None:
    found = everything(renderer, np.empty((len(PLANES), 0), np.float32), camera(*size))
    assert (found['image'][4] == 1).all() and not found['image'][:4].any()
    assert found['planes'].shape == (len(PLANES), 0) and found['weights'].shape == (0,)
    assert not found['pose'].any()


@pytest.mark.parametrize('opacity', [0.05, 0.5, 0.99, 0.9999])
def test_at_its_middle_a_gaussian_has_the_alpha_of_its_opacity(
    renderer: CpuRenderer, opacity: float
) -> None:
    color, z = (0.9, 0.2, 0.4), 2.0
    view = View(70, 40, 50.0, 60.0, 41.0, 7.0, np.eye(4))
    seen = renderer.render(one(z, opacity, color), view)
    alpha = min(opacity, ALPHA_MAX)
    np.testing.assert_allclose(
        seen.planes[:, 7, 41], [*(alpha * np.array(color)), alpha * z, 1 - alpha], atol=CLOSED_FORM
    )
    assert seen.transmittance[0, 0] == 1 and not seen.color[:, 0, 0].any()


def test_what_is_fainter_than_the_least_alpha_is_not_seen(renderer: CpuRenderer) -> None:
    view = camera(9, 9)
    for opacity, seen in ((0.98 * ALPHA_MIN, False), (1.02 * ALPHA_MIN, True)):
        found = everything(renderer, one(2.0, opacity, (1, 1, 1)), view)
        assert found['touched'][0] == seen == (found['image'][4] < 1).any()


@pytest.mark.parametrize('size', [(1, 1), (31, 33), (32, 32), (33, 31), (64, 1), (3, 96)])
@pytest.mark.parametrize('name', ['ordinary', 'huge'])
def test_images_of_any_size_are_the_references(
    renderer: CpuRenderer, name: str, size: tuple[int, int]
) -> None:
    made = scene(name, 1)
    width, height = size
    view = replace(made.view, width=width, height=height, cx=0.45 * width, cy=0.5 * height)
    planes = torch.from_numpy(made.planes.astype(np.float64))
    expected = render(planes, view, torch.zeros(6, dtype=torch.float64)).numpy()
    sure = ~doubtful(planes, view, MARGIN)
    found = renderer.render(made.planes, view).planes
    limits = np.array([1, 1, 1, max(1.0, expected[3].max()), 1])[:, None]
    assert (np.abs(found - expected)[:, sure] < IMAGE * limits).all()


def composited(
    z: NDArray[np.floating], opacity: NDArray[np.floating], red: NDArray[np.floating]
) -> tuple[float, float, int]:
    """Red, what shines through, and how many take part, of Gaussians all middled on a pixel."""
    through, total = 1.0, 0.0
    order = np.argsort(z, kind='stable')
    for k, i in enumerate(order):
        if through * (1 - opacity[i]) <= T_MIN:
            return total, through, k
        total += through * opacity[i] * red[i]
        through *= 1 - opacity[i]
    return total, through, len(order)


@pytest.mark.parametrize('farthest', [0.1001, 1.0, 100.0, 1e5])
@pytest.mark.parametrize('equal', [False, True])
def test_thousands_in_one_tile_are_blended_front_to_back(
    renderer: CpuRenderer, farthest: float, equal: bool
) -> None:
    """Over any range of depths; equal ones in their order."""
    count, rng = 3000, np.random.default_rng(2)
    planes = np.repeat(one(1.0, 0.5, (0.5, 0.5, 0.5)), count, axis=1)
    planes[2] = np.exp(rng.uniform(np.log(0.1), np.log(farthest), count))
    if equal:
        planes[2] = rng.choice(planes[2, :7], count)
    planes[3:6] = np.log(planes[2])
    opacity, red = rng.uniform(0.01, 0.03, count), rng.uniform(-1, 2, count)
    planes[10], planes[11] = np.log(opacity / (1 - opacity)), (red - 0.5) / SH_C0
    found = everything(renderer, planes, View(1, 1, 1.0, 1.0, 0.0, 0.0, np.eye(4)))
    total, through, blended = composited(planes[2], opacity, red)
    assert blended < count  # the pixel ends
    np.testing.assert_allclose(found['image'][[0, 4], 0, 0], [total, through], atol=CLOSED_FORM)
    last = np.sort(planes[2])[blended - 1]
    assert not found['touched'][planes[2] > last].any()
    assert found['touched'].sum() == pytest.approx(blended, abs=1)


def test_weights_add_up_to_what_does_not_shine_through(renderer: CpuRenderer) -> None:
    for name in ('ordinary', 'huge', 'saturated', 'border', 'inside', 'opaque'):
        for seed in range(3):
            made = scene(name, seed)
            found = everything(renderer, made.planes, made.view)
            assert (found['weights'] >= 0).all()
            covered = (1 - found['image'][4].astype(np.float64)).sum()
            assert found['weights'].sum() == pytest.approx(covered, rel=WEIGHTS, abs=WEIGHTS)


def test_nothing_changes_when_world_and_camera_move_together(renderer: CpuRenderer) -> None:
    planes, view = crowd(3, 200), camera(64, 48)
    M = se3.exp(np.array([0.5, -1.0, 0.7, 0.9, -0.4, 1.3]))
    moved = planes.copy()
    moved[0:3] = M[:3, :3] @ planes[0:3] + M[:3, 3:]
    turned = Rotation.from_matrix(M[:3, :3]) * Rotation.from_quat(planes[[7, 8, 9, 6]].T)
    moved[6:10] = turned.as_quat().T[[3, 0, 1, 2]]
    here = everything(renderer, planes, view)
    there = everything(renderer, moved, replace(view, T_world_cam=M))
    error = np.abs(there['image'] - here['image'])
    assert np.quantile(error, 0.99) < IMAGE and error.max() < 4 * ALPHA_MIN
    by = {'camera': 'pose', 'weight': 'weights'}
    pairs = {label: (there[name], here[name]) for label, name in by.items()}
    pairs['mean'] = (M[:3, :3].T @ there['planes'][0:3], here['planes'][0:3])
    pairs |= {
        'scale': (there['planes'][3:6], here['planes'][3:6]),
        'opacity and colour': (there['planes'][10:], here['planes'][10:]),
    }
    for label, (found, expected) in pairs.items():
        assert np.linalg.norm(found - expected) < TURNED * np.linalg.norm(expected), label


def test_a_camera_in_the_midst_of_a_gaussian_sees_finite_numbers(renderer: CpuRenderer) -> None:
    ball = one(0.0, 0.9, (1, 1, 1))
    ball[3:6] = np.log(0.5)
    for z in (-0.3, 0.0, 0.9 * NEAR_M, 1.1 * NEAR_M, 0.3):
        ball[2] = z
        found = everything(renderer, ball, camera(40, 30))
        assert found['touched'][0] == (z > NEAR_M)
        assert all(np.isfinite(values).all() for values in found.values())
        assert found['image'][4, 15, 20] == pytest.approx(0.1 if z > NEAR_M else 1.0, abs=0.02)


def test_buffers_serve_a_larger_and_a_smaller_scene_in_turn(renderer: CpuRenderer) -> None:
    cases = [
        (crowd(4, 50), camera(64, 48)),
        (crowd(5, 700), camera(200, 100)),
        (crowd(6, 5), camera(10, 90)),
        (np.empty((len(PLANES), 0), np.float32), camera(33, 33)),
        (crowd(4, 50), camera(64, 48)),
    ]
    for planes, view in cases:
        with closing(Workers(1)) as workers:
            fresh = everything(CpuRenderer(workers), planes, view)
        assert_same(everything(renderer, planes, view), fresh)


def test_how_the_planes_lie_in_memory_does_not_matter(renderer: CpuRenderer) -> None:
    planes, view = crowd(7, 48), camera(64, 48)
    expected = everything(renderer, planes, view)
    wide = np.full((len(PLANES), 99), np.nan, np.float32)
    wide[:, 20:68] = planes
    for same in (wide[:, 20:68], np.asfortranarray(planes), np.repeat(planes, 2, 1)[:, ::2]):
        before = same.copy()
        assert_same(everything(renderer, same, view), expected)
        np.testing.assert_array_equal(same, before)


def test_too_many_pairs_are_refused_with_the_numbers(
    renderer: CpuRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    planes, view = crowd(8, 30), camera(128, 96)
    expected = everything(renderer, planes, view)
    large = planes.copy()
    large[3:6] = np.log(50.0)
    large[10] = 0.0
    monkeypatch.setattr(cpu, '_MAX_PAIRS', 30 * 12 - 1)
    with pytest.raises(RenderError, match=r'30 Gaussians cover 360 tiles of 128x96.* than 359'):
        renderer.render(large, view)
    assert_same(everything(renderer, planes, view), expected)


@pytest.mark.parametrize(
    'planes',
    [
        np.zeros((13, 16), np.float32),
        np.zeros((14, 16)),
        np.zeros(14, np.float32),
        np.zeros((14, 4, 4), np.float32),
    ],
    ids=lambda planes: f'{planes.dtype}{planes.shape}',
)
def test_other_planes_are_refused_with_what_they_are(
    renderer: CpuRenderer, planes: NDArray[np.floating]
) -> None:
    with pytest.raises(RenderError, match=str(planes.dtype)):
        renderer.render(planes, camera(20, 20))


@pytest.mark.parametrize(
    'gradient',
    [np.zeros((5, 21, 20), np.float32), np.zeros((4, 20, 20), np.float32), np.zeros((5, 20, 20))],
    ids=lambda gradient: f'{gradient.dtype}{gradient.shape}',
)
def test_a_gradient_of_another_image_is_refused(
    renderer: CpuRenderer, gradient: NDArray[np.floating]
) -> None:
    renderer.render(crowd(9, 5), camera(20, 20))
    with pytest.raises(RenderError, match=r'not float32 \(5, 20, 20\)'):
        renderer.backward(gradient)


def test_a_gradient_before_any_image_is_refused() -> None:
    with pytest.raises(RenderError):
        CpuRenderer(Workers(1)).backward(np.zeros((5, 20, 20), np.float32))


@pytest.mark.parametrize('garbage', [np.nan, np.inf, -np.inf])
def test_a_parameter_that_is_not_finite_hides_its_gaussian_and_no_other(
    renderer: CpuRenderer, garbage: float
) -> None:
    view = camera(64, 48)
    planes = crowd(10, 48)
    bad = np.arange(0, 2 * len(PLANES), 2)
    poisoned = planes.copy()
    poisoned[np.arange(len(PLANES)), bad] = garbage
    hidden = planes.copy()
    hidden[10, bad] = -100.0
    with np.errstate(invalid='raise', over='raise'):
        found, expected = (everything(renderer, p, view) for p in (poisoned, hidden))
    assert_same(found, expected)
    assert not found['touched'][bad].any() and found['touched'].any()


def test_a_gradient_that_is_not_finite_touches_nobody_and_spares_the_others(
    renderer: CpuRenderer,
) -> None:
    """One pixel of the upstream gradient is NaN: it is some Gaussians' and the pose's no more."""
    planes, view = crowd(11, 100), camera(96, 64)
    image = renderer.render(planes, view).planes
    upstream = np.ones_like(image)
    upstream[1, 40, 50] = np.nan
    gradients = renderer.backward(upstream)
    assert np.isfinite(gradients.planes[:, gradients.touched]).all()
    assert np.isfinite(gradients.pose).all()
    seen = gradients.weights > 0
    assert 0 < np.count_nonzero(seen & ~gradients.touched) < np.count_nonzero(seen)


@pytest.mark.parametrize('seed', range(12))
def test_whatever_the_parameters_the_image_is_finite(renderer: CpuRenderer, seed: int) -> None:
    """Any bits, and needles as long as float32 can represent, in any view."""
    rng = np.random.default_rng(seed)
    for _ in range(10):
        count = int(rng.integers(1, 60))
        planes = crowd(int(rng.integers(1 << 30)), count)
        bits = rng.integers(0, 1 << 32, planes.shape, dtype=np.uint32).view(np.float32)
        planes = np.where(rng.random(planes.shape) < 0.1, bits, planes)
        planes[rng.integers(3, 6, count // 2), np.arange(count // 2)] = rng.uniform(-90, 90)
        width, height = rng.integers(1, 150, 2).tolist()
        fx, fy = 10.0 ** rng.uniform(0, 4, 2)
        T = se3.exp(rng.normal(size=6))
        cx, cy = rng.normal(scale=100, size=2)
        view = View(width, height, fx, fy, cx, cy, T)
        found = everything(renderer, planes.astype(np.float32), view)
        assert all(np.isfinite(values).all() for values in found.values())
        assert ((found['image'][4] >= 0) & (found['image'][4] <= 1)).all()
        assert not found['touched'][~np.isfinite(planes).all(axis=0)].any()
