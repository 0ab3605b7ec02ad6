# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What `renderer` defines, as short as torch allows: autograd does the backward pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dcgs_ros.core.mapping.splats import SH_C0
from dcgs_ros.core.render.renderer import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLUR_PX2,
    MARGIN,
    NEAR_M,
    T_MIN,
    View,
)

REACH_SIGMAS = 3.33  # where an opacity of 1 has fallen to ALPHA_MIN


class Gaussians(NamedTuple):
    """N Gaussians after their activations, world frame."""

    means: Tensor  # (N, 3)
    scales: Tensor  # (N, 3)
    quats_wxyz: Tensor  # (N, 4) of any length
    opacities: Tensor  # (N,)
    features: Tensor  # (N, D)


class Projected(NamedTuple):
    """Those that are in front of the camera, front to back."""

    centers: Tensor  # (M, 2) pixels, that of the first pixel is (0, 0)
    covariances: Tensor  # (M, 2, 2)
    opacities: Tensor  # (M,)
    features: Tensor  # (M, D + 1) the last is the depth


def render(planes: Tensor, view: View, xi: Tensor, tile_px: int | None = None) -> Tensor:
    """Image (5, H, W) of planes (14, N) from T_world_cam exp(xi), in their precision.

    With `tile_px` in square tiles, each of the Gaussians that reach it; else all for each pixel.
    """
    T_cam_world = torch.linalg.inv(torch.as_tensor(view.T_world_cam).to(xi) @ exponential(xi))
    image, through = blend(project(activated(planes), view, T_cam_world), view, tile_px)
    return torch.cat([image, through[None]])


def render_tiled(planes: Tensor, view: View, xi: Tensor) -> Tensor:
    """Render as a GPU does, in tiles of 16 pixels: for images too large for `render`."""
    return render(planes, view, xi, tile_px=16)


def exponential(xi: Tensor) -> Tensor:
    """exp(xi) (4, 4) of a twist (rho, phi): of its own matrix, which needs no case for phi = 0."""
    zero = torch.zeros_like(xi[0])
    a, b, c, x, y, z = xi
    rows = [[zero, -z, y, a], [z, zero, -x, b], [-y, x, zero, c], [zero, zero, zero, zero]]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows]))


def activated(planes: Tensor) -> Gaussians:
    """Planes (14, N) to what they stand for; those that are not finite are left out."""
    p = planes.T[torch.isfinite(planes.detach()).all(dim=0)]
    colors = 0.5 + SH_C0 * p[:, 11:14]
    return Gaussians(p[:, 0:3], p[:, 3:6].exp(), p[:, 6:10], torch.sigmoid(p[:, 10]), colors)


def project(gaussians: Gaussians, view: View, T_cam_world: Tensor) -> Projected:
    """Linearise the projection at each mean (Zwicker et al. 2001), or at MARGIN at most."""
    R, t = T_cam_world[:3, :3], T_cam_world[:3, 3]
    z = (gaussians.means @ R.T + t)[:, 2].detach()
    order = torch.argsort(z, stable=True)
    kept = order[(z[order] >= NEAR_M) & (z[order] < view.far_m)]
    means, scales, quats, opacities, features = (tensor[kept] for tensor in gaussians)
    x, y, z = (means @ R.T + t).T
    focal, center = t.new_tensor([view.fx, view.fy]), t.new_tensor([view.cx, view.cy])
    size = t.new_tensor([view.width, view.height]) / focal
    low = -(center + 0.5) / focal  # of x/z and y/z at the border of the image
    slopes = torch.stack([x / z, y / z], dim=1)
    u, v = torch.clamp(slopes, low - 0.5 * MARGIN * size, low + size + 0.5 * MARGIN * size).T
    zero = torch.zeros_like(z)
    J = torch.stack([view.fx / z, zero, -view.fx * u / z, zero, view.fy / z, -view.fy * v / z], 1)
    A = J.reshape(-1, 2, 3) @ R @ rotations(quats) * scales[:, None, :]
    covariances = A @ A.transpose(1, 2) + BLUR_PX2 * torch.eye(2).to(t)
    features = torch.cat([features, z[:, None]], dim=1)
    return Projected(slopes * focal + center, covariances, opacities, features)


def rotations(quats_wxyz: Tensor) -> Tensor:
    """Quaternions (N, 4) of any length to matrices (N, 3, 3)."""
    w, x, y, z = (quats_wxyz / quats_wxyz.norm(dim=1, keepdim=True)).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).reshape(-1, 3, 3)


def blend(p: Projected, view: View, tile_px: int | None) -> tuple[Tensor, Tensor]:
    """Composite the features (D + 1, H, W) front to back; and what shines through (H, W)."""
    if tile_px is None:
        return _blend_tile(p, 0, 0, view.width, view.height)
    reach = REACH_SIGMAS * torch.diagonal(p.covariances.detach(), dim1=1, dim2=2).sqrt()
    low, high = p.centers.detach() - reach, p.centers.detach() + reach
    rows = []
    for y in range(0, view.height, tile_px):
        row = []
        for x in range(0, view.width, tile_px):
            x1, y1 = min(x + tile_px, view.width), min(y + tile_px, view.height)
            meets = (high[:, 0] >= x) & (low[:, 0] < x1) & (high[:, 1] >= y) & (low[:, 1] < y1)
            features, through = _blend_tile(Projected(*(a[meets] for a in p)), x, y, x1, y1)
            row.append(torch.cat([features, through[None]]))
        rows.append(torch.cat(row, dim=2))
    image = torch.cat(rows, dim=1)
    return image[:-1], image[-1]


def _blend_tile(p: Projected, x0: int, y0: int, x1: int, y1: int) -> tuple[Tensor, Tensor]:
    alpha = torch.clamp(_responses(p, x0, y0, x1, y1), max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    ended = torch.cumprod(1 - alpha.detach(), dim=0) <= T_MIN
    alpha = torch.where(ended, 0.0, alpha)
    ahead = torch.ones(1, *alpha.shape[1:]).to(alpha)
    through = torch.cumprod(torch.cat([ahead, 1 - alpha]), dim=0)
    return torch.einsum('nhw,nd->dhw', alpha * through[:-1], p.features), through[-1]


def _responses(p: Projected, x0: int, y0: int, x1: int, y1: int) -> Tensor:
    """Opacity times the Gaussian, (M, H, W), at the pixels x0 to x1 - 1 and y0 to y1 - 1."""
    x, y = torch.arange(x0, x1).to(p.centers), torch.arange(y0, y1).to(p.centers)
    dx = x[None, None, :] - p.centers[:, 0, None, None]
    dy = y[None, :, None] - p.centers[:, 1, None, None]
    conics = torch.linalg.inv(p.covariances)[..., None, None]
    square = conics[:, 0, 0] * dx**2 + 2 * conics[:, 0, 1] * dx * dy + conics[:, 1, 1] * dy**2
    return p.opacities[:, None, None] * torch.exp(-0.5 * square)


@torch.no_grad()
def doubtful(planes: Tensor, view: View, margin: float) -> NDArray[np.bool_]:
    """Pixels (H, W) where an alpha or T is within `margin`, relative, of one of its limits.

    There another precision may decide otherwise, and the image or its gradient jump.
    """
    T_cam_world = torch.linalg.inv(torch.as_tensor(view.T_world_cam).to(planes))
    projected = project(activated(planes), view, T_cam_world)
    response = _responses(projected, 0, 0, view.width, view.height)
    alpha = torch.clamp(response, max=ALPHA_MAX)
    through = torch.cumprod(1 - torch.where(alpha >= ALPHA_MIN, alpha, 0.0), dim=0)
    near = ((response / ALPHA_MIN - 1).abs() < margin) | (
        (response / ALPHA_MAX - 1).abs() < margin
    )
    near |= (through / T_MIN - 1).abs() < margin
    return near.any(dim=0).numpy()
