# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The CUDA renderer where there is no CUDA: what it says, and that it speaks gsplat's language."""

from __future__ import annotations

import subprocess
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from reference import Gaussians, blend, project, render  # type: ignore[import-not-found]
from scenes import Scene, scene  # type: ignore[import-not-found]
from torch import Tensor

from dcgs_ros.core.mapping.splats import SH_C0
from dcgs_ros.core.render.cuda import CudaRenderer
from dcgs_ros.core.render.renderer import BLUR_PX2, NEAR_M, RenderError, View

torch.set_num_threads(1)

FLOAT32 = 1e-5  # relative: parameters and pose pass through float32
IMPORT = """
import sys
import dcgs_ros.core.render.cuda
print([name for name in ('torch', 'gsplat') if name in sys.modules])
"""


def rasterization(
    *,
    means: Tensor,  # (N, 3)
    quats: Tensor,  # (N, 4) wxyz
    scales: Tensor,  # (N, 3)
    opacities: Tensor,  # (N,)
    colors: Tensor,  # (N, D)
    viewmats: Tensor,  # (1, 4, 4) T_cam_world
    Ks: Tensor,  # (1, 3, 3) the centre of the first pixel is (1/2, 1/2)
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    eps2d: float,
    packed: bool,
    render_mode: str,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Do what gsplat 1.5 does for these arguments, by the reference in float64."""
    assert (near_plane, eps2d, packed, render_mode) == (NEAR_M, BLUR_PX2, False, 'RGB+D')
    assert len(means) > 0
    (fx, _, cx), (_, fy, cy), _ = Ks[0].tolist()
    view = View(width, height, fx, fy, cx - 0.5, cy - 0.5, np.eye(4), far_plane)
    activated = (t.double() for t in (means, scales, quats, opacities, colors))
    image, through = blend(project(Gaussians(*activated), view, viewmats[0].double()), view, None)
    features = image.permute(1, 2, 0)[None].float()
    return features, 1.0 - through[None, :, :, None].float(), {}


@pytest.fixture
def renderer(monkeypatch: pytest.MonkeyPatch) -> CudaRenderer:
    gsplat = ModuleType('gsplat')
    gsplat.rasterization = rasterization  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, 'gsplat', gsplat)
    return CudaRenderer('cpu')


def relative(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


@pytest.mark.parametrize('name', ['ordinary', 'behind', 'unnormalised', 'one', 'not_finite'])
def test_numbers_go_to_gsplat_and_come_back_as_the_reference_has_them(
    renderer: CudaRenderer, name: str
) -> None:
    made: Scene = scene(name, 1)
    planes = torch.from_numpy(made.planes.astype(np.float64)).requires_grad_()
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    image = render(planes, made.view, xi)
    found = renderer.render(made.planes, made.view).planes
    assert found.dtype == np.float32
    assert found.shape == image.shape
    assert relative(found, image.detach().numpy()) < FLOAT32

    upstream = np.random.default_rng(2).normal(size=image.shape).astype(np.float32)
    by_planes, by_xi = torch.autograd.grad(
        image, (planes, xi), torch.from_numpy(upstream).double(), retain_graph=True
    )
    gradients = renderer.backward(upstream)
    assert gradients.planes.dtype == np.float32
    assert relative(gradients.planes, by_planes.numpy()) < FLOAT32
    assert relative(gradients.pose, by_xi.numpy()) < FLOAT32
    # Red is the sum of w_i (1/2 + SH_C0 f_dc_0): its derivative by f_dc_0 counts the w_i.
    (by_red,) = torch.autograd.grad(image[0].sum(), planes)
    weights = by_red[11].numpy() / SH_C0
    np.testing.assert_allclose(gradients.weights, weights, rtol=FLOAT32, atol=FLOAT32)
    np.testing.assert_array_equal(gradients.touched, weights > 0)


def test_a_second_gradient_of_the_same_rendering_is_its_own(renderer: CudaRenderer) -> None:
    made: Scene = scene('ordinary', 1)
    image = renderer.render(made.planes, made.view).planes
    first, second = np.ones_like(image), np.full_like(image, -2.0)
    np.testing.assert_allclose(
        renderer.backward(second).planes, -2.0 * renderer.backward(first).planes, rtol=FLOAT32
    )


def test_an_empty_map_is_black(renderer: CudaRenderer) -> None:
    made: Scene = scene('none', 1)
    image = renderer.render(made.planes, made.view).planes
    assert not image[:4].any()
    assert np.all(image[4] == 1.0)
    gradients = renderer.backward(np.ones_like(image))
    assert gradients.planes.shape == (14, 0)
    assert gradients.weights.shape == gradients.touched.shape == (0,)
    assert not gradients.pose.any()


def test_arrays_that_do_not_fit_are_refused(renderer: CudaRenderer) -> None:
    made: Scene = scene('one', 1)
    with pytest.raises(RenderError, match=r'\(13, 1\), not float32 \(14, N\)'):
        renderer.render(made.planes[1:], made.view)
    with pytest.raises(RenderError, match='float64'):
        renderer.render(made.planes.astype(np.float64), made.view)
    image = renderer.render(made.planes, made.view).planes
    with pytest.raises(RenderError, match=r'gradient is float32 \(4, '):
        renderer.backward(image[:4])


@pytest.mark.skipif(torch.cuda.is_available(), reason='CUDA is there')
def test_without_cuda_the_renderer_says_so() -> None:
    with pytest.raises(RenderError, match='sees no CUDA device'):
        CudaRenderer()


def test_without_gsplat_the_renderer_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'gsplat', None)
    with pytest.raises(RenderError, match='needs torch and gsplat'):
        CudaRenderer('cpu')


def test_a_gsplat_that_was_not_compiled_is_found_out_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def rasterization(**_: object) -> None:
        raise AttributeError("'NoneType' object has no attribute 'projection'")

    gsplat = ModuleType('gsplat')
    gsplat.rasterization = rasterization  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, 'gsplat', gsplat)
    with pytest.raises(RenderError, match="needs torch and gsplat: 'NoneType'"):
        CudaRenderer('cpu')


@pytest.mark.slow
def test_neither_torch_nor_gsplat_is_loaded_before_a_renderer_is_made() -> None:
    done = subprocess.run(
        [sys.executable, '-c', IMPORT], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == '[]'
