# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Every renderer against the reference in float64: the image, and the gradient by everything."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from reference import doubtful, render  # type: ignore[import-not-found]
from scenes import NAMES, Scene, scene  # type: ignore[import-not-found]

from dcgs_ros.core import se3
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.mapping.splats import SH_C0
from dcgs_ros.core.render.renderer import ALPHA_MIN, BLUR_PX2, Renderer

torch.set_num_threads(1)

IMAGE = 1e-4  # absolute in colour and transmittance, relative to the farthest in depth
GRADIENT = 1e-4  # relative L2, in each group
MARGIN = 1e-4  # relative: closer to a threshold float32 and float64 may disagree about a pixel
MAX_DOUBTFUL = 0.01  # share of the pixels left out for that, or one pixel
# The turn of a needle 30 pixels long and 0.02 wide: float32 cannot tell it better.
ILL_CONDITIONED = {'needles': 1e-3}  # instead of GRADIENT
EXACT = 1e-12
GROUPS = {
    'mean': slice(0, 3),
    'scale': slice(3, 6),
    'rotation': slice(6, 10),
    'opacity': slice(10, 11),
    'color': slice(11, 14),
}


@pytest.fixture(params=['cpu', 'cuda'])
def renderer(request: pytest.FixtureRequest) -> Renderer:
    if request.param == 'cpu':
        from dcgs_ros.core.render.cpu import CpuRenderer

        return CpuRenderer(Workers(2))
    if not torch.cuda.is_available():
        pytest.skip('no CUDA here')
    from dcgs_ros.core.render.cuda import CudaRenderer

    return CudaRenderer()


class Expected(NamedTuple):
    """What the reference makes of a scene and an upstream gradient."""

    image: NDArray[np.float64]  # (5, H, W)
    sure: NDArray[np.bool_]  # (H, W) pixels where every precision takes the same decisions
    upstream: NDArray[np.float32]  # (5, H, W) zero where not sure
    planes: NDArray[np.float64]  # (14, N) gradient
    pose: NDArray[np.float64]  # (6,) gradient
    weights: NDArray[np.float64]  # (N,)


def expected(scene: Scene, seed: int) -> Expected:
    planes = torch.from_numpy(scene.planes.astype(np.float64)).requires_grad_()
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    sure = ~doubtful(planes, scene.view, MARGIN)
    assert np.count_nonzero(~sure) <= max(1.0, MAX_DOUBTFUL * sure.size)
    image = render(planes, scene.view, xi)
    rng = np.random.default_rng(seed)
    upstream = (rng.normal(size=image.shape) * sure).astype(np.float32)
    by_planes, by_xi = torch.autograd.grad(
        image, (planes, xi), torch.from_numpy(upstream.astype(np.float64)), retain_graph=True
    )
    # Red is the sum of w_i (1/2 + SH_C0 f_dc_0): its derivative by f_dc_0 counts the w_i.
    (by_red,) = torch.autograd.grad(image[0].sum(), planes)
    weights = by_red[11].numpy() / SH_C0
    return Expected(
        image.detach().numpy(), sure, upstream, by_planes.numpy(), by_xi.numpy(), weights
    )


def relative(found: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """Relative L2 error; 0 where there is nothing and nothing was found."""
    error = float(np.linalg.norm(found - truth))
    return error / float(np.linalg.norm(truth)) if error else 0.0


def test_the_reference_sees_one_gaussian_as_the_formula_has_it() -> None:
    made = scene('one', 0)
    view = replace(made.view, fx=40.0, fy=50.0, T_world_cam=np.eye(4))
    sigma, z, opacity = 0.1, 2.0, 0.7
    planes = torch.zeros(14, 1, dtype=torch.float64)
    planes[2], planes[3:6], planes[6] = z, np.log(sigma), 1.0
    planes[10], planes[11] = np.log(opacity / (1 - opacity)), 1.0
    image = render(planes, view, torch.zeros(6, dtype=torch.float64)).numpy()
    y, x = np.mgrid[: view.height, : view.width]
    square = (x - view.cx) ** 2 / ((view.fx * sigma / z) ** 2 + BLUR_PX2)
    square += (y - view.cy) ** 2 / ((view.fy * sigma / z) ** 2 + BLUR_PX2)
    alpha = opacity * np.exp(-0.5 * square)
    alpha[alpha < ALPHA_MIN] = 0.0
    features = np.array([0.5 + SH_C0, 0.5, 0.5, z])
    np.testing.assert_allclose(image[:4], features[:, None, None] * alpha, atol=EXACT)
    np.testing.assert_allclose(image[4], 1.0 - alpha, atol=EXACT)


def test_the_reference_moves_by_xi_as_the_package_does() -> None:
    made = scene('ordinary', 1)
    planes = torch.from_numpy(made.planes.astype(np.float64))
    xi = 0.1 * np.array([0.3, -0.2, 0.4, 0.5, -0.6, 0.2])
    moved = replace(made.view, T_world_cam=made.view.T_world_cam @ se3.exp(xi))
    nothing = torch.zeros(6, dtype=torch.float64)
    np.testing.assert_allclose(
        render(planes, made.view, torch.from_numpy(xi)), render(planes, moved, nothing), atol=1e-9
    )


@pytest.mark.parametrize('name', ['ordinary', 'border', 'huge'])
def test_the_reference_in_tiles_is_the_reference(name: str) -> None:
    made = scene(name, 1)
    planes = torch.from_numpy(made.planes.astype(np.float64))
    nothing = torch.zeros(6, dtype=torch.float64)
    whole = render(planes, made.view, nothing)
    tiled = render(planes, made.view, nothing, tile_px=16)
    np.testing.assert_allclose(tiled, whole, atol=EXACT)


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('name', NAMES)
def test_image_and_gradients_are_the_references(renderer: Renderer, name: str, seed: int) -> None:
    made = scene(name, seed)
    truth = expected(made, seed)
    image = renderer.render(made.planes, made.view).planes
    limits = np.array([1.0, 1.0, 1.0, max(1.0, truth.image[3].max()), 1.0])
    errors = np.abs(image - truth.image)[:, truth.sure].max(axis=1, initial=0.0) / limits
    assert errors.max() < IMAGE, f'error by plane: {errors}'

    found = renderer.backward(truth.upstream)
    planes = np.where(found.touched, found.planes, 0.0)
    by_group = {
        group: relative(planes[rows], truth.planes[rows]) for group, rows in GROUPS.items()
    }
    by_group['pose'] = relative(found.pose, truth.pose)
    assert max(by_group.values()) < ILL_CONDITIONED.get(name, GRADIENT), by_group
    # A pixel in doubt may add or miss one blending weight of ALPHA_MIN.
    slack = IMAGE + ALPHA_MIN * np.count_nonzero(~truth.sure)
    np.testing.assert_allclose(found.weights, truth.weights, rtol=GRADIENT, atol=slack)
