# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The difference of a rendering from its keyframe, and its gradient by every rendered pixel.

Colour is compared by L1 and by SSIM (Wang et al. 2004) with the window of 3D Gaussian Splatting:
11 x 11, Gaussian of sigma 1.5, zeros beyond the border. Depth is compared by L1.

The gradient is the analytic one. With blurred means mx, my and moments of an image x and a target
y, SSIM = S(mx, E[xx + yy], E[xy]), and since the window is symmetric

    d sum SSIM / dx = blur(dS/dmx) + 2 x blur(dS/dE[xx]) + y blur(dS/dE[xy]).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DcgsError
from ..kernels.jit import kernel
from ..kernels.workers import PIECES, Workers
from .exposure import Exposure

_RADIUS = 5  # pixels: the window is 11 x 11
_WINDOW = 2 * _RADIUS + 1
_SIGMA = 1.5  # pixels
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)  # plain 2.0 is a double
_INFINITY = np.float32(np.inf)
_MOMENTS = 4  # blurred x, y, xx + yy and xy: SSIM needs only the sum of the squares
_SLOPES = 3  # derivatives of SSIM by the blurred x, xx and xy


def _half_window() -> tuple[np.float32, ...]:
    """Return the weights of the window's pixels 0, 1 ... _RADIUS from its centre."""
    g = np.exp(-0.5 * (np.arange(-_RADIUS, _RADIUS + 1) / _SIGMA) ** 2)
    return tuple(np.float32(weight) for weight in (g / g.sum())[_RADIUS:])


_W0, _W1, _W2, _W3, _W4, _W5 = _half_window()


class LossError(DcgsError):
    """Images that cannot be compared."""


@dataclass(frozen=True)
class Target:
    """The images of a keyframe that a rendering is compared with, planar."""

    color: NDArray[np.float32]  # (3, H, W) 0 to 1
    depth_m: NDArray[np.float32]  # (H, W) metres; 0 or not finite: no depth
    valid: NDArray[np.bool_]  # (H, W) pixels to compare: undistortion leaves corners empty

    def __post_init__(self) -> None:
        """Check shapes and types."""
        height_width = self.depth_m.shape
        _check('color', self.color, (3, *height_width), np.float32)
        _check('depth_m', self.depth_m, height_width, np.float32)
        _check('valid', self.valid, height_width, np.bool_)


class ImageLoss:
    """(1 - s) L1 + s (1 - SSIM) of the colours + w L1 of the depth, for images of one size.

    L1 and SSIM are means over pixels and channels, the depth's L1 is a mean over all pixels. A
    pixel that is not valid counts as rendered without error, so it does not change the loss.
    Results do not depend on the number of threads.
    """

    def __init__(
        self, width: int, height: int, ssim_weight: float, depth_weight: float, workers: Workers
    ) -> None:
        """Allocate the buffers, 29 planes of the image's size; `LossError` without pixels."""
        if width < 1 or height < 1:
            raise LossError(f'an image of {width}x{height} pixels is empty')
        self._ssim_weight, self._depth_weight = ssim_weight, depth_weight
        self._workers = workers
        self._gradient = np.zeros((5, height, width), np.float32)
        self._shown = np.zeros((3, height, width), np.float32)
        # Side by side in a row, so that one call blurs all; zeros above and below the image.
        padded = height + 2 * _RADIUS
        self._moments = np.zeros((3, padded, _MOMENTS * width), np.float32)
        self._slopes = np.zeros((3, padded, _SLOPES * width), np.float32)
        # Work space of each piece: a row of each with zeros at both ends, and a blurred row.
        self._rows = np.zeros((PIECES, _MOMENTS, width + 2 * _RADIUS), np.float32)
        self._blurred = np.zeros((PIECES, _MOMENTS * width), np.float32)
        self._sums = np.zeros((PIECES, 3))  # of SSIM, |colour error| and |depth error|

    def gradient(
        self,
        planes: NDArray[np.float32],  # (5, H, W) as in `Rendering`, finite
        target: Target,
        exposure: Exposure,
        background: NDArray[np.float32],  # (3,) colour behind the Gaussians
    ) -> NDArray[np.float32]:
        """Return the gradient by `planes`, (5, H, W), valid until the next call.

        `value` is then the loss. Raises `LossError` for arrays of another shape or type.
        """
        _check('planes', planes, self._gradient.shape, np.float32)
        _check('target', target.color, self._shown.shape, np.float32)
        _check('background', background, (3,), np.float32)
        # The kernels are vectorised only along contiguous rows.
        rendered, color = np.ascontiguousarray(planes), np.ascontiguousarray(target.color)
        depth_m, valid = np.ascontiguousarray(target.depth_m), np.ascontiguousarray(target.valid)
        run, pixels = self._workers.run, depth_m.size
        color_weight = np.float32((1.0 - self._ssim_weight) / (3 * pixels))
        ssim_weight = np.float32(self._ssim_weight / (3 * pixels))
        depth_weight = np.float32(self._depth_weight / pixels)
        run(
            _compose, rendered, color, valid, exposure.gain, exposure.offset, background,
            self._shown, self._rows, self._moments,
        )  # fmt: skip
        run(_compare, self._moments, self._blurred, self._rows, self._slopes, self._sums)
        run(
            _differentiate, rendered, color, depth_m, valid, exposure.gain, background,
            self._shown, self._slopes, self._blurred, color_weight, ssim_weight, depth_weight,
            self._gradient[:3], self._gradient[3], self._gradient[4], self._sums,
        )  # fmt: skip
        return self._gradient

    @property
    def value(self) -> float:
        """The loss at the last call of `gradient`."""
        ssim, color, depth = self._sums.sum(axis=0) / self._shown[0].size
        return float(
            (1.0 - self._ssim_weight) * color / 3.0
            + self._ssim_weight * (1.0 - ssim / 3.0)
            + self._depth_weight * depth
        )


def _check(
    name: str, array: NDArray[Any], shape: tuple[int, ...], dtype: type[np.generic]
) -> None:
    if array.shape != shape or array.dtype != dtype:
        raise LossError(f'{name} is {array.shape} {array.dtype}, not {shape} {dtype.__name__}')


# Each inner loop is a function of whole arrays, so that LLVM sees that they do not overlap, or can
# check it, and vectorises; it does not if the loop is written out in a kernel. W is the width; all
# arrays are float32 but `valid` (bool); colours are 0 to 1, depths metres.


@kernel
def _blur_along(padded, out):
    """Blur the row `padded` (W + 2 _RADIUS,), zeros at both ends; write `out` (W,)."""
    for x in range(out.shape[0]):
        out[x] = (
            _W0 * padded[x + 5]
            + _W1 * (padded[x + 4] + padded[x + 6])
            + _W2 * (padded[x + 3] + padded[x + 7])
            + _W3 * (padded[x + 2] + padded[x + 8])
            + _W4 * (padded[x + 1] + padded[x + 9])
            + _W5 * (padded[x] + padded[x + 10])
        )


@kernel
def _blur_across(rows, out):
    """Blur `rows` (_WINDOW, W) into one row; write `out` (W,)."""
    for x in range(out.shape[0]):
        out[x] = (
            _W0 * rows[5, x]
            + _W1 * (rows[4, x] + rows[6, x])
            + _W2 * (rows[3, x] + rows[7, x])
            + _W3 * (rows[2, x] + rows[8, x])
            + _W4 * (rows[1, x] + rows[9, x])
            + _W5 * (rows[0, x] + rows[10, x])
        )


@kernel
def _show(color, through, target, valid, gain, behind, offset, shown):
    """Apply background and exposure to one channel of a row; write `shown` (W,).

    `color`, `through` (transmittance), `target` and `valid` (W,); `gain`, `behind` (background
    times gain) and `offset` are numbers. A pixel that is not valid shows the target.
    """
    for x in range(shown.shape[0]):
        seen = gain * color[x] + behind * through[x] + offset
        shown[x] = seen if valid[x] else target[x]


@kernel
def _multiply(shown, target, rows):
    """Write x, y, xx + yy and xy into `rows` (_MOMENTS, W + 2 _RADIUS), not into its ends.

    x is `shown` (W,), y is `target` (W,).
    """
    for x in range(shown.shape[0]):
        a, b = shown[x], target[x]
        rows[0, x + _RADIUS] = a
        rows[1, x + _RADIUS] = b
        rows[2, x + _RADIUS] = a * a + b * b
        rows[3, x + _RADIUS] = a * b


@kernel(error_model='numpy')  # else each division may raise, which prevents vectorisation
def _similarity(moments, rows):
    """Return the sum of SSIM over a row; write its derivatives by three of the moments.

    `moments` (_MOMENTS, W) blurred; writes `rows` (_SLOPES, W + 2 _RADIUS), not its ends.
    """
    total = _ZERO
    for x in range(moments.shape[1]):
        a, b, squares, product = moments[0, x], moments[1, x], moments[2, x], moments[3, x]
        ab, aabb = a * b, a * a + b * b
        light, structure = _TWO * ab + _C1, _TWO * (product - ab) + _C2
        lights, structures = aabb + _C1, squares - aabb + _C2
        inverse = _ONE / (lights * structures)
        similarity = light * structure * inverse
        total += similarity
        spread = b * (structure - light) - a * similarity * (structures - lights)
        rows[0, x + _RADIUS] = _TWO * inverse * spread
        rows[1, x + _RADIUS] = -similarity * lights * inverse
        rows[2, x + _RADIUS] = _TWO * light * inverse
    return total


@kernel
def _derive_depth(depth, through, target, valid, weight, by_depth, by_through):
    """Return the sum of a row's absolute depth errors, metres; write their derivatives.

    The error is D - d (1 - T) with `depth` D (W,), `through` T (W,) and `target` d (W,); `valid`
    (W,). Writes `by_depth` and `by_through` (W,), times `weight`.
    """
    total = _ZERO
    for x in range(target.shape[0]):
        counts = valid[x] and target[x] > _ZERO and target[x] < _INFINITY
        d = target[x] if counts else _ZERO
        error = depth[x] - d * (_ONE - through[x]) if counts else _ZERO
        slope = weight if error > _ZERO else (-weight if error < _ZERO else _ZERO)
        total += abs(error)
        by_depth[x] = slope
        by_through[x] = slope * d
    return total


@kernel
def _derive_color(
    shown, target, valid, slopes, gain, behind, color_weight, ssim_weight, by_color, by_through
):
    """Return the sum of a row's absolute colour errors in one channel; write the derivatives.

    `shown`, `target` and `valid` (W,), `slopes` (_SLOPES, W) blurred derivatives of SSIM; `gain`
    and `behind` as in `_show`. Writes `by_color` (W,) and adds to `by_through` (W,).
    """
    total = _ZERO
    for x in range(shown.shape[0]):
        a, b = shown[x], target[x]
        total += abs(a - b)
        slope = color_weight if a > b else (-color_weight if a < b else _ZERO)
        slope -= ssim_weight * (slopes[0, x] + _TWO * a * slopes[1, x] + b * slopes[2, x])
        slope = slope if valid[x] else _ZERO
        by_color[x] = gain * slope
        by_through[x] += behind * slope
    return total


@kernel
def _compose(
    piece, pieces, planes, target, valid, gain, offset, background, shown, rows, moments
):  # fmt: skip
    """Apply background and exposure; blur the moments along the piece's rows.

    `planes` (5, H, W) as in `Rendering`, `target` (3, H, W), `valid` (H, W), `gain`, `offset` and
    `background` (3,). Writes `shown` (3, H, W) and `moments` (3, H + 2 _RADIUS, _MOMENTS W), not
    the rows above and below; `rows` (pieces, _MOMENTS, W + 2 _RADIUS) is work space.
    """
    channels, height, width = shown.shape
    for y in range(height * piece // pieces, height * (piece + 1) // pieces):
        for c in range(channels):
            _show(
                planes[c, y], planes[4, y], target[c, y], valid[y], gain[c],
                gain[c] * background[c], offset[c], shown[c, y],
            )  # fmt: skip
            _multiply(shown[c, y], target[c, y], rows[piece])
            out = moments[c, y + _RADIUS].reshape(_MOMENTS, width)
            for m in range(_MOMENTS):
                _blur_along(rows[piece, m], out[m])


@kernel
def _compare(piece, pieces, moments, blurred, rows, slopes, sums):
    """Blur the moments across the piece's rows; blur the derivatives of SSIM along them.

    `moments` as `_compose` leaves them. Writes `slopes` (3, H + 2 _RADIUS, _SLOPES W) and
    `sums[piece, 0]`, the sum of SSIM, float64; `blurred` (pieces, _MOMENTS W) and `rows` (pieces,
    _MOMENTS, W + 2 _RADIUS) are work space.
    """
    channels, height = slopes.shape[0], slopes.shape[1] - 2 * _RADIUS
    width = slopes.shape[2] // _SLOPES
    sums[piece, 0] = 0.0
    for y in range(height * piece // pieces, height * (piece + 1) // pieces):
        for c in range(channels):
            _blur_across(moments[c, y : y + _WINDOW], blurred[piece])
            sums[piece, 0] += _similarity(blurred[piece].reshape(_MOMENTS, width), rows[piece])
            out = slopes[c, y + _RADIUS].reshape(_SLOPES, width)
            for m in range(_SLOPES):
                _blur_along(rows[piece, m], out[m])


@kernel
def _differentiate(
    piece, pieces, planes, target, depth, valid, gain, background, shown, slopes, blurred,
    color_weight, ssim_weight, depth_weight, by_color, by_depth, by_through, sums,
):  # fmt: skip
    """Blur the derivatives of SSIM across the piece's rows; write those of the loss.

    `planes`, `target`, `valid`, `gain` and `background` as in `_compose`, `depth` (H, W) the
    target's, `shown` and `slopes` as left by `_compose` and `_compare`. Writes `by_color`
    (3, H, W), `by_depth` and `by_through` (H, W), and `sums[piece, 1:]`, the sums of the absolute
    errors of colour and depth, float64; `blurred` (pieces, _MOMENTS W) is work space.
    """
    channels, height, width = shown.shape
    here = blurred[piece, : _SLOPES * width]
    sums[piece, 1] = sums[piece, 2] = 0.0
    for y in range(height * piece // pieces, height * (piece + 1) // pieces):
        sums[piece, 2] += _derive_depth(
            planes[3, y], planes[4, y], depth[y], valid[y], depth_weight, by_depth[y],
            by_through[y],
        )  # fmt: skip
        for c in range(channels):
            _blur_across(slopes[c, y : y + _WINDOW], here)
            sums[piece, 1] += _derive_color(
                shown[c, y], target[c, y], valid[y], here.reshape(_SLOPES, width), gain[c],
                gain[c] * background[c], color_weight, ssim_weight, by_color[c, y], by_through[y],
            )  # fmt: skip
