# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The renderer for NVIDIA GPUs: gsplat's kernels, torch's backward pass.

Both are imported when a renderer is made, not before.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..mapping.splats import PLANES, SH_C0
from .renderer import BLUR_PX2, NEAR_M, Gradients, RenderError, Rendering, View

if TYPE_CHECKING:
    import torch

_HIDDEN_LOGIT = -100.0  # of the opacity
_ONES = 3  # feature after the colour; gsplat appends the depth
_NO_GAUSSIANS = np.zeros((len(PLANES), 0), np.float32)
_FARTHEST_M = 1e10  # what gsplat takes for no limit
_ONE_PIXEL = View(1, 1, 1.0, 1.0, 0.0, 0.0, np.eye(4))


class CudaRenderer:
    """A `Renderer` on the GPU; its sums are atomic, so gradients differ in the last digits."""

    def __init__(self, device: str = 'cuda') -> None:
        """Import gsplat and try it. Raises `RenderError` if it or a GPU is missing."""
        self._device = device
        try:
            import torch

            if torch.device(device).type == 'cuda' and not torch.cuda.is_available():
                raise RenderError(f'torch {torch.__version__} sees no CUDA device')
            from gsplat import rasterization  # type: ignore[import-not-found]

            # It compiles its kernels on import; if that failed, only a call reports it.
            self._rasterization = rasterization
            self.render(_NO_GAUSSIANS, _ONE_PIXEL)
        except (ImportError, AttributeError, RuntimeError, OSError) as error:
            raise RenderError(f'the CUDA renderer needs torch and gsplat: {error}') from error

    def render(self, planes: NDArray[np.float32], view: View) -> Rendering:
        """Return an image of the Gaussians of `planes` (14, N); see `Renderer`."""
        if planes.ndim != 2 or len(planes) != len(PLANES) or planes.dtype != np.float32:
            raise RenderError(f'planes are {planes.dtype} {planes.shape}, not float32 (14, N)')
        import torch

        leaf = torch.from_numpy(_usable(planes)).to(self._device).requires_grad_()
        pose = leaf.new_tensor(se3.inverse(view.T_world_cam)).requires_grad_()
        ones = torch.ones_like(leaf[0]).requires_grad_()
        K = [[view.fx, 0.0, view.cx + 0.5], [0.0, view.fy, view.cy + 0.5], [0.0, 0.0, 1.0]]
        colors = 0.5 + SH_C0 * leaf[11:14].T
        features, opaque, _ = self._rasterization(
            means=leaf[0:3].T,
            quats=leaf[6:10].T,
            scales=leaf[3:6].T.exp(),
            opacities=torch.sigmoid(leaf[10]),
            colors=torch.cat([colors, ones[:, None]], dim=1),
            viewmats=pose[None],
            Ks=leaf.new_tensor(K)[None],
            width=view.width,
            height=view.height,
            near_plane=NEAR_M,
            far_plane=min(view.far_m, _FARTHEST_M),
            eps2d=BLUR_PX2,
            packed=False,
            render_mode='RGB+D',
        )
        image = torch.cat([features, 1.0 - opaque], dim=3)[0].permute(2, 0, 1)
        self._last = _Pass(image, leaf, pose, ones, planes.shape[1])
        return Rendering(np.delete(image.detach().cpu().numpy(), _ONES, axis=0))

    def backward(self, gradient: NDArray[np.float32]) -> Gradients:
        """Return the derivatives, given dL / d planes (5, H, W) of the last rendering."""
        image, leaf, pose, ones, n = self._last
        shape = (5, *image.shape[1:])
        if gradient.shape != shape or gradient.dtype != np.float32:
            raise RenderError(
                f'gradient is {gradient.dtype} {gradient.shape}, not float32 {shape}'
            )
        import torch

        upstream = image.new_tensor(np.insert(gradient, _ONES, 0.0, axis=0))
        by_planes, by_pose = torch.autograd.grad(image, (leaf, pose), upstream, retain_graph=True)
        # The image of the ones is the sum of the blending weights, linear in each Gaussian's.
        (weights,) = torch.autograd.grad(image[_ONES].sum(), ones, retain_graph=True)
        counted = weights[:n].cpu().numpy()
        return Gradients(
            by_planes[:, :n].cpu().numpy(),
            counted > 0.0,
            _by_twist(pose.detach().cpu().double().numpy(), by_pose.cpu().double().numpy()),
            counted,
        )


class _Pass(NamedTuple):
    """What the backward pass needs of the forward pass."""

    image: torch.Tensor  # (6, H, W) colour, ones, depth, transmittance
    planes: torch.Tensor  # (14, N + 1)
    T_cam_world: torch.Tensor  # (4, 4)
    ones: torch.Tensor  # (N + 1,)
    splats: int  # N


def _usable(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return planes (14, N + 1): Gaussians that are not finite hidden, and a hidden one appended.

    gsplat rejects an empty map.
    """
    hidden = np.zeros((len(planes), 1), np.float32)
    hidden[PLANES.index('rot_0')] = 1.0
    hidden[PLANES.index('opacity')] = _HIDDEN_LOGIT
    finite = np.isfinite(planes).all(axis=0)
    return np.concatenate([np.where(finite, planes, hidden), hidden], axis=1)


def _by_twist(T_cam_world: NDArray[np.float64], by_T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return dL/dxi (6,) for T_world_cam exp(xi), given dL/dT_cam_world (4, 4).

    Its inverse is exp(-xi) T_cam_world: a column c of the rotation moves by -phi x c, the
    translation t by -rho - phi x t.
    """
    turning = np.cross(T_cam_world[:3].T, by_T[:3].T).sum(axis=0)
    return -np.concatenate([by_T[:3, 3], turning])
