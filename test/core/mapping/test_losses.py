# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The image loss and its gradient against autograd in float64, and what must not count."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.mapping.exposure import Exposure, ExposureError
from dcgs_ros.core.mapping.losses import ImageLoss, LossError, Target

torch.set_num_threads(1)

GRADIENT = 2e-5  # relative L2: the kernels are float32
VALUE = 2e-6  # relative
EXACT = 1e-12
SSIM_WEIGHT, DEPTH_WEIGHT = 0.2, 0.1
WORKERS = Workers(2)
SIZES = [(64, 48), (37, 53), (12, 16), (101, 17), (5, 40), (1, 1)]
NEUTRAL = Exposure(np.ones(3, np.float32), np.zeros(3, np.float32))
BLACK = np.zeros(3, np.float32)


@dataclass(frozen=True)
class Comparison:
    """What `ImageLoss.gradient` takes."""

    planes: NDArray[np.float32]
    target: Target
    exposure: Exposure
    background: NDArray[np.float32]

    def evaluate(
        self, ssim_weight: float = SSIM_WEIGHT, depth_weight: float = DEPTH_WEIGHT,
        workers: Workers = WORKERS,
    ) -> tuple[float, NDArray[np.float32]]:  # fmt: skip
        _, height, width = self.planes.shape
        loss = ImageLoss(width, height, ssim_weight, depth_weight, workers)
        gradient = loss.gradient(self.planes, self.target, self.exposure, self.background)
        return loss.value, gradient


def smooth_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Noise with some large structure in it, 0 to 1."""
    coarse = rng.uniform(size=(*shape[:-2], shape[-2] // 8 + 1, shape[-1] // 8 + 1))
    large = coarse.repeat(8, axis=-2).repeat(8, axis=-1)[..., : shape[-2], : shape[-1]]
    return (0.7 * large + 0.3 * rng.uniform(size=shape)).astype(np.float32)


def comparison(seed: int, width: int, height: int) -> Comparison:
    """Rendering and target that resemble each other, with holes, flat regions and an exposure."""
    rng = np.random.default_rng(seed)
    color = smooth_noise(rng, (3, height, width))
    color[:, : height // 3, : width // 2] = 0.9  # flat and bright
    color[:, -(height // 4) :, width // 2 :] = 0.0
    depth = rng.uniform(0.5, 4, (height, width)).astype(np.float32)
    through = rng.uniform(size=(height, width)).astype(np.float32) ** 4
    planes = np.empty((5, height, width), np.float32)
    planes[:3] = color + rng.normal(scale=0.1, size=color.shape)
    planes[:3, : height // 6, : width // 2] = 0.8
    planes[3] = depth * (1 - through) + rng.normal(scale=0.05, size=depth.shape)
    planes[4] = through
    depth[rng.uniform(size=depth.shape) < 0.2] = 0.0
    valid = rng.uniform(size=depth.shape) < 0.9
    valid[:, : width // 8] = False
    exposure = Exposure(
        rng.uniform(0.7, 1.3, 3).astype(np.float32), rng.normal(0, 0.05, 3).astype(np.float32)
    )
    background = rng.uniform(size=3).astype(np.float32)
    return Comparison(planes, Target(color, depth, valid), exposure, background)


def blur(images: torch.Tensor) -> torch.Tensor:
    """11 x 11 Gaussian of sigma 1.5 on each of (C, H, W), zeros beyond the border."""
    x = torch.arange(-5, 6, dtype=torch.float64)
    window = torch.exp(-(x[:, None] ** 2 + x[None, :] ** 2) / (2 * 1.5**2))
    kernel = (window / window.sum())[None, None]
    return torch.nn.functional.conv2d(images[:, None], kernel, padding=5)[:, 0]


def ssim_reference(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    mx, my = blur(x), blur(y)
    vx, vy, covariance = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    light = (2 * mx * my + c1) / (mx**2 + my**2 + c1)
    return light * (2 * covariance + c2) / (vx + vy + c2)


def reference(
    case: Comparison, ssim_weight: float = SSIM_WEIGHT, depth_weight: float = DEPTH_WEIGHT
) -> tuple[float, NDArray[np.float64]]:
    """The definition of the loss in double precision, and torch's gradient of it."""
    planes, color, depth, background, gain, offset = (
        torch.from_numpy(np.asarray(array, np.float64))
        for array in (
            case.planes, case.target.color, case.target.depth_m, case.background,
            case.exposure.gain, case.exposure.offset,
        )
    )  # fmt: skip
    valid = torch.from_numpy(case.target.valid)
    planes.requires_grad_()
    seen = planes[:3] + background[:, None, None] * planes[4]
    seen = torch.where(valid, gain[:, None, None] * seen + offset[:, None, None], color)
    error = (planes[3] - depth * (1 - planes[4])).abs()
    loss = (
        (1 - ssim_weight) * (seen - color).abs().mean()
        + ssim_weight * (1 - ssim_reference(seen, color).mean())
        + depth_weight * torch.where(valid & (depth > 0), error, torch.zeros_like(error)).mean()
    )
    loss.backward()
    assert planes.grad is not None
    return loss.item(), planes.grad.numpy()


def relative(found: NDArray[np.floating], expected: NDArray[np.floating]) -> float:
    """Relative L2 error."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize(('width', 'height'), SIZES)
@pytest.mark.parametrize('seed', range(3))
def test_value_and_gradient_are_those_of_autograd(seed: int, width: int, height: int) -> None:
    case = comparison(seed, width, height)
    if width < 8:  # no column is left out: the one of a single pixel must count
        valid = np.ones_like(case.target.valid)
        case = replace(case, target=replace(case.target, valid=valid))
    value, gradient = case.evaluate()
    expected, slope = reference(case)
    assert value == pytest.approx(expected, rel=VALUE)
    assert relative(gradient, slope) < GRADIENT


@pytest.mark.parametrize(('ssim_weight', 'depth_weight'), [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
def test_each_term_alone(ssim_weight: float, depth_weight: float) -> None:
    case = comparison(3, 70, 45)
    value, gradient = case.evaluate(ssim_weight, depth_weight)
    expected, slope = reference(case, ssim_weight, depth_weight)
    assert value == pytest.approx(expected, rel=VALUE)
    assert relative(gradient, slope) < GRADIENT
    assert np.any(gradient[3]) == (depth_weight > 0)


@pytest.mark.parametrize('plane', range(5))
def test_the_gradient_is_the_slope_of_the_value(plane: int) -> None:
    case = comparison(4, 24, 18)
    _, gradient = case.evaluate()
    direction = gradient[plane] / np.linalg.norm(gradient[plane])
    step = 1e-3

    def moved(by: float) -> float:
        planes = case.planes.copy()
        planes[plane] += np.float32(by) * direction
        return replace(case, planes=planes).evaluate()[0]

    slope = (moved(step) - moved(-step)) / (2 * step)
    assert slope == pytest.approx(float(np.sum(gradient[plane] * direction)), rel=1e-2)


def test_pixels_that_do_not_count_pull_nothing_and_change_nothing() -> None:
    case = comparison(5, 61, 40)
    value, gradient = case.evaluate()
    hidden = ~case.target.valid
    assert np.all(gradient[:, hidden] == 0.0)
    for rubbish in (-1e3, 0.0, 7.0):
        planes = case.planes.copy()
        planes[:, hidden] = rubbish
        again, same = replace(case, planes=planes).evaluate()
        assert again == value
        np.testing.assert_array_equal(same, gradient)


@pytest.mark.parametrize('nothing', [0.0, -1.0, np.nan, np.inf])
def test_depth_that_was_not_measured_pulls_nothing(nothing: float) -> None:
    case = comparison(6, 40, 30)
    holes = case.target.depth_m == 0
    depth_m = np.where(holes, np.float32(nothing), case.target.depth_m)
    value, gradient = replace(case, target=replace(case.target, depth_m=depth_m)).evaluate()
    expected, slope = case.evaluate()
    assert value == expected
    np.testing.assert_array_equal(gradient, slope)
    assert np.all(gradient[3, holes] == 0.0)


def test_of_two_equal_images_nothing_is_left() -> None:
    case = comparison(7, 50, 33)
    planes = np.concatenate([case.target.color, case.target.depth_m[None], case.planes[4:]])
    planes[4] = 0.0
    same = Comparison(planes, case.target, NEUTRAL, BLACK)
    l1_and_depth, gradient = same.evaluate(ssim_weight=0.0)
    assert l1_and_depth == 0.0
    assert not gradient.any()
    dissimilarity, _ = same.evaluate(ssim_weight=1.0)
    assert abs(dissimilarity) < VALUE


def test_the_background_shines_through_what_is_transparent() -> None:
    case = comparison(8, 30, 20)
    empty = np.zeros_like(case.planes)
    empty[4] = 1.0
    background = np.array([0.2, 0.5, 0.8], np.float32)
    color = np.empty_like(case.target.color)
    color[:] = 2.0 * background[:, None, None] + np.float32(0.125)
    exposure = Exposure(np.full(3, 2, np.float32), np.full(3, 0.125, np.float32))
    target = replace(case.target, color=color, depth_m=np.ones_like(case.target.depth_m))
    value, gradient = Comparison(empty, target, exposure, background).evaluate(ssim_weight=0.0)
    assert value == 0.0  # D = 0 = d (1 - T)
    assert not gradient.any()


def test_the_references_ssim_is_scikit_images_away_from_the_border() -> None:
    case = comparison(9, 83, 60)
    image, target = (x.astype(np.float64) for x in (case.planes[:3], case.target.color))
    _, expected = structural_similarity(
        image, target, channel_axis=0, data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    found = ssim_reference(torch.from_numpy(image), torch.from_numpy(target)).numpy()
    inside = (slice(None), slice(5, -5), slice(5, -5))
    np.testing.assert_allclose(found[inside], expected[inside], atol=EXACT)


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    case = comparison(11, 75, 50)
    results = [case.evaluate(workers=Workers(threads)) for threads in (1, 2, 5)]
    for value, gradient in results[1:]:
        assert value == results[0][0]
        assert gradient.tobytes() == results[0][1].tobytes()


def test_a_call_leaves_nothing_behind_for_the_next() -> None:
    first, second = comparison(12, 40, 30), comparison(13, 40, 30)
    loss = ImageLoss(40, 30, SSIM_WEIGHT, DEPTH_WEIGHT, WORKERS)
    for case in (first, second):
        gradient = loss.gradient(case.planes, case.target, case.exposure, case.background)
    value, expected = second.evaluate()
    assert loss.value == value
    np.testing.assert_array_equal(gradient, expected)


def test_images_that_are_not_contiguous_are_taken() -> None:
    case = comparison(14, 40, 30)
    t = case.target
    strided = Target(np.asfortranarray(t.color), np.asfortranarray(t.depth_m), t.valid)
    value, gradient = replace(case, target=strided).evaluate()
    expected, slope = case.evaluate()
    assert value == expected
    np.testing.assert_array_equal(gradient, slope)


def test_images_that_do_not_fit_are_refused() -> None:
    case = comparison(15, 40, 30)
    with pytest.raises(LossError, match='0x480 pixels'):
        ImageLoss(0, 480, SSIM_WEIGHT, DEPTH_WEIGHT, WORKERS)
    loss = ImageLoss(40, 31, SSIM_WEIGHT, DEPTH_WEIGHT, WORKERS)
    with pytest.raises(LossError, match=r'planes is \(5, 30, 40\).*not \(5, 31, 40\)'):
        loss.gradient(case.planes, case.target, case.exposure, case.background)
    planes = np.zeros((5, 31, 40), np.float32)
    with pytest.raises(LossError, match=r'target is \(3, 30, 40\).*not \(3, 31, 40\)'):
        loss.gradient(planes, case.target, case.exposure, case.background)
    with pytest.raises(LossError, match=r'planes is .* float64, not .* float32'):
        double = planes.astype(np.float64)
        loss.gradient(double, case.target, case.exposure, case.background)  # type: ignore[arg-type]
    with pytest.raises(LossError, match=r'background is \(4,\)'):
        replace(case, background=np.zeros(4, np.float32)).evaluate()
    with pytest.raises(LossError, match='valid'):
        replace(case.target, valid=case.target.valid.astype(np.uint8))
    with pytest.raises(LossError, match='color'):
        replace(case.target, color=case.target.color[:, :-1])
    with pytest.raises(ExposureError, match=r'gain is \(1,\)'):
        Exposure(np.ones(1, np.float32), np.zeros(3, np.float32))
