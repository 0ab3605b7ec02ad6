# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Scores of a saved map against the images of its sequence."""

from __future__ import annotations

from collections.abc import Collection, Generator
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ..core.frame import RgbdFrame
from ..core.mapping.rectification import Rectifier
from ..core.render.renderer import Renderer
from ..core.trajectory import Trajectory
from ..datasets.prefetch import prefetch_frames
from ..datasets.source import Source, SourceError
from ..io.map_archive import SavedMap
from .contact_sheet import MAX_ROWS, ContactPair
from .lpips import Lpips
from .map_view import MapView
from .rendering import ViewScores, score_view
from .similarity import psnr_db

_LPIPS_VIEWS = 40  # LPIPS takes about a second a view


@dataclass(frozen=True)
class MapScores:
    """Scores of the views of a map, and some views to look at."""

    scores: list[ViewScores] = field(default_factory=list)
    pairs: list[ContactPair] = field(default_factory=list)  # of a few frames, keyframes last


def score_map(
    saved: SavedMap, trajectory: Trajectory, source: Source, every: int, renderer: Renderer
) -> MapScores:
    """Read the source again and score each frame whose index is a multiple of `every`.

    `trajectory` holds the tracked poses; frames without a pose, as lost ones are, are skipped.
    LPIPS is computed for about 40 of the views, spread evenly. Raises `MapFileError` for an
    invalid map, `SourceError` if the source is not the one that the map was made from.
    """
    view, found = MapView(saved, renderer), MapScores()
    _check_size(saved, source)
    on_sheet = _for_contact_sheet(trajectory, view.keyframes)
    lpips, lpips_every = Lpips.load(), -(-len(trajectory) // (every * _LPIPS_VIEWS))
    rectify = Rectifier(saved.camera)
    with closing(_with_poses(source, trajectory)) as frames:
        for index, frame, T_tracked in frames:
            if index % every and frame.stamp_ns not in on_sheet:
                continue
            rendered = _render(view, rectify, index, frame, T_tracked)
            if index % every == 0:
                sampled = len(found.scores) % lpips_every == 0
                found.scores.append(rendered.score(lpips if sampled else None))
            if frame.stamp_ns in on_sheet:
                found.pairs.append(rendered.pair())
    if not found.scores:
        raise SourceError(f'{source.name}: none of its frames has one of {len(trajectory)} poses')
    return found


@dataclass(frozen=True)
class _RenderedFrame:
    """A frame and its rendering from the map."""

    index: int
    keyframe: bool
    shown: NDArray[np.float32]  # (H, W, 3)
    exposed: NDArray[np.float32]  # (H, W, 3) with the exposure interpolated
    real: NDArray[np.float32]  # (H, W, 3)
    depth_m: NDArray[np.float32]  # (H, W) of the camera
    valid: NDArray[np.bool_]  # (H, W)
    transmittance: NDArray[np.float32]  # (H, W)

    def score(self, lpips: Lpips | None) -> ViewScores:
        return score_view(
            self.index, self.keyframe, self.shown, self.exposed, self.real, self.depth_m,
            self.valid, self.transmittance, lpips,
        )  # fmt: skip

    def pair(self) -> ContactPair:
        psnr = psnr_db(np.clip(self.shown, 0, 1), self.real, self.valid)
        return ContactPair(f'frame {self.index + 1}, {psnr:.1f} dB', self.shown, self.real)


def _render(
    view: MapView, rectify: Rectifier, index: int, frame: RgbdFrame, T_tracked: NDArray[np.float64]
) -> _RenderedFrame:
    """Rectify a frame and render the map at its pose."""
    images, rendering = rectify(frame), view.show(frame.stamp_ns, T_tracked)
    shown = np.ascontiguousarray(np.moveaxis(rendering.color, 0, -1))
    return _RenderedFrame(
        index, frame.stamp_ns in view.keyframes, shown, view.exposed(frame.stamp_ns, shown),
        images.color.astype(np.float32) / np.float32(255), images.depth_m, rectify.valid,
        rendering.transmittance,
    )  # fmt: skip


def _check_size(saved: SavedMap, source: Source) -> None:
    """Raise `SourceError` if the source's images are not of the size of the map's."""
    sizes = [f'{camera.width}x{camera.height}' for camera in (source.camera, saved.camera)]
    if sizes[0] != sizes[1]:
        raise SourceError(f'{source.name} has images of {sizes[0]} pixels, the map of {sizes[1]}')


def _for_contact_sheet(trajectory: Trajectory, keyframes: Collection[int]) -> set[int]:
    """Return stamps spread evenly over the sequence, of keyframes only if there are no others."""
    stamps = [stamp for stamp in trajectory.stamps_ns.tolist() if stamp not in keyframes]
    stamps = stamps or trajectory.stamps_ns.tolist()
    return {stamps[(2 * k + 1) * len(stamps) // (2 * MAX_ROWS)] for k in range(MAX_ROWS)}


def _with_poses(
    source: Source, trajectory: Trajectory
) -> Generator[tuple[int, RgbdFrame, NDArray[np.float64]], None, None]:
    """Yield index, frame and pose of the frames that have one; a terminal shows a bar."""
    poses = dict(zip(trajectory.stamps_ns.tolist(), trajectory.T_world_cam, strict=True))
    bar = tqdm(total=len(poses), unit='frame', desc='scoring', disable=None, dynamic_ncols=True)
    with bar, closing(prefetch_frames(source, len(source), quietly=True)) as items:
        for index, item in enumerate(items):
            if isinstance(item, RgbdFrame) and item.stamp_ns in poses:
                yield index, item, poses.pop(item.stamp_ns)
                bar.update()
            if not poses:
                return
