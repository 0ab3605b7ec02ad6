# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The mapper: optimises the Gaussians so that their renderings look like the keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .. import se3
from ..camera import PinholeCamera
from ..config.stages import Config
from ..errors import DcgsError
from ..kernels.workers import Workers, cores
from ..keyframe import Correction, Keyframe, KeyframePose, MapUpdate, PosedFrame
from ..render import make_renderer
from ..render.renderer import Renderer, Rendering, View
from ..self_mask import covered
from . import exposure
from .corrections import Corrections
from .exposure import Exposure
from .keyframe_poses import KeyframePoses
from .losses import ImageLoss, Target
from .rectification import Images, Rectifier
from .seeding import Surface
from .splat_table import SplatTable
from .splats import SH_C0, Splats
from .strategy import DefaultDensification, Densification, Observation
from .view_choice import COARSE, ViewScheduler
from .views import KeyframeView, bend, shrink_memory

_EXPOSURE_INTERVAL = 4  # visits of a view between two fits of its exposure


def mapper_threads(config: Config, online: bool = False) -> int:
    """Return how many threads a mapper gets: as configured, by default all cores.

    Online the mapper works while the tracker does, which keeps one core.
    """
    return config.threads or max(1, cores() - online)


class MapperError(DcgsError):
    """A keyframe that the mapper cannot use, or a step without keyframes."""


class Mapper:
    """Photometric optimisation of the map over a window of newest and replayed keyframes.

    Gaussians that the tracker spawned have its ids (0, 1 ...); those that the mapper adds where
    an image needs more have ids from -1 downwards and are not reported to the tracker.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        config: Config,
        renderer: Renderer | None = None,
        workers: Workers | None = None,
        strategy: Densification | None = None,
    ) -> None:
        """Start with an empty map.

        By default `workers` are `mapper_threads`, `renderer` is what `make_renderer` finds for
        them, and `strategy` is `DefaultDensification`.
        """
        workers = workers or Workers(mapper_threads(config))
        self.camera, self.config = camera, config
        self.table = SplatTable()
        self.views: list[KeyframeView] = []
        self.steps = 0
        self.revision = 0  # of the last correction
        self.poisoned = 0  # Gaussians dropped because a parameter was not finite
        self._renderer, self._workers = renderer or make_renderer(workers), workers
        self._strategy = strategy or DefaultDensification()
        mask = covered(config.self_mask, camera.width, camera.height)
        self._rectify = Rectifier(camera, mask)
        settings = config.mapping
        self._losses = {
            shrink: ImageLoss(
                camera.width // shrink, camera.height // shrink, settings.ssim_weight,
                settings.depth_weight, workers,
            )
            for shrink in (1, COARSE)
        }  # fmt: skip
        self._random = np.random.default_rng(settings.seed)
        self._scheduler = ViewScheduler(self._random)
        self._keyframes = KeyframePoses()
        self._next_own_id = -1
        self._removed: list[NDArray[np.int64]] = []

    def insert(self, posed: PosedFrame) -> None:
        """Add a keyframe or a view: its Gaussians if any, and those that the strategy adds.

        One that was tracked before a correction is placed where that has moved its keyframe.
        Raises `MapperError` for an invalid one; the mapper is then as it was before.
        """
        keyframe = posed if isinstance(posed, Keyframe) else _without_gaussians(posed)
        self._check(keyframe)
        reference = self._keyframes.reference(posed)
        if reference is not None:
            keyframe = keyframe.moved(self._keyframes.motion_since(reference))
        images = self._rectify(keyframe.frame, keyframe.T_cam_cam_at_depth)
        view = KeyframeView.of(
            len(self.views), keyframe.frame.stamp_ns, keyframe.T_world_cam, images,
            self.views[-1] if self.views else None,
        )  # fmt: skip
        if keyframe.odometry is not None:
            view.keyframe = keyframe.odometry.keyframe
        view.reference_ns = None if reference is None else reference.stamp_ns
        if isinstance(posed, Keyframe):
            self._keyframes.made_in(view.stamp_ns, posed.submap)
        self.views.append(view)
        coarse = View.of(self.camera, view.T_world_cam, COARSE)
        rendering = self._renderer.render(self.table.planes, coarse)
        target = view.target(self._rectify.valid, COARSE, self._workers)
        view.exposure = self._exposed(view, rendering, target)
        self._center_exposures()
        self._spawn(keyframe, view, images, rendering)
        if shrink_memory(self.views, 1e6 * self.config.mapping.image_memory_mb):
            self._scheduler.restart()

    def restore(
        self,
        splats: Splats,
        ids: NDArray[np.int64],  # (N,)
        hosts: NDArray[np.int32],  # (N,)
        measured: NDArray[np.float32],  # (N, 3) when they were added, the tracker's world, metres
        reach_m: NDArray[np.float32],  # (N,)
        weights: NDArray[np.float32],  # (N,)
        views: Sequence[KeyframeView],
        submaps: Sequence[int] = (),
    ) -> None:
        """Fill an empty mapper with a map that was saved; its optimisation begins anew.

        `submaps` are those of the tracker's keyframes, by their number, by default all 0.
        """
        self.views = list(views)
        for view in self.views:
            if view.keyframe >= 0:
                view.reference_ns = view.stamp_ns
                self._keyframes.motion_since(KeyframePose(view.stamp_ns, view.T_tracked))
                if submaps:
                    self._keyframes.made_in(view.stamp_ns, submaps[view.keyframe])
        planes = Splats(splats.planes.copy())
        self.table.append(planes, ids, hosts, np.ascontiguousarray(measured.T), reach_m)
        self.table.weights[:] = weights
        if self.views:
            self.table.place_anchors(np.array([view.T_map_tracked for view in self.views]))
        self._next_own_id = min(int(ids.min(initial=0)), 0) - 1

    @property
    def submaps(self) -> list[int]:
        """The sub-map of each view, which is that of its keyframe."""
        return self._keyframes.submaps([view.reference_ns or view.stamp_ns for view in self.views])

    def _check(self, keyframe: Keyframe) -> None:
        height, width = keyframe.frame.depth_m.shape
        if (width, height) != (self.camera.width, self.camera.height):
            raise MapperError(
                f'the image is {width}x{height} pixels, the camera '
                f'{self.camera.width}x{self.camera.height}'
            )
        n = len(keyframe.ids)
        if keyframe.means.shape != (n, 3) or keyframe.normals.shape != (n, 3):
            raise MapperError(
                f'{n} ids come with means {keyframe.means.shape} and normals '
                f'{keyframe.normals.shape}'
            )
        different = len(np.unique(keyframe.ids))
        if different != n:
            raise MapperError(f'{n} Gaussians of a keyframe have only {different} different ids')
        for name in ('T_world_cam', 'T_cam_cam_at_depth'):
            if not np.all(np.isfinite(getattr(keyframe, name))):
                raise MapperError(f'{name} of a keyframe is not finite')

    def _spawn(
        self, keyframe: Keyframe, view: KeyframeView, images: Images, rendering: Rendering
    ) -> None:
        """Add the Gaussians that the strategy makes of a keyframe, up to `max_gaussians`."""
        config = self.config.mapping
        keyframe = self._news(keyframe)
        camera = View.of(self.camera, view.T_world_cam)
        moved = view.T_world_cam @ se3.inverse(keyframe.T_world_cam)
        measured = Surface(
            se3.transform(moved, keyframe.means).astype(np.float32),
            (keyframe.normals @ moved[:3, :3].T).astype(np.float32),
            np.ones(len(keyframe.ids), np.bool_),
        )
        valid = self._rectify.valid
        seen = Observation(images, valid, camera, view.exposure, rendering, COARSE)
        planes = self._strategy.seed(seen, measured, self.config).planes
        if planes.shape[1] < len(keyframe.ids):
            raise MapperError(
                f'the strategy returned {planes.shape[1]} Gaussians, fewer than the '
                f'{len(keyframe.ids)} that the tracker spawned'
            )
        own_points = np.ascontiguousarray(planes[:3, len(keyframe.ids) :].T)
        own_ids = self._next_own_id - np.arange(len(own_points), dtype=np.int64)
        self._next_own_id -= len(own_ids)
        room = slice(max(0, config.max_gaussians - len(self.table)))
        planes = planes[:, room]
        sigma_z = self._sigma_z(measured, camera)
        reach_m = np.full(planes.shape[1], np.inf, np.float32)
        reach_m[: len(sigma_z)] = config.reach_sigmas * sigma_z[room]
        own = se3.transform(se3.inverse(moved), own_points)
        tracked = np.concatenate([keyframe.means, own])[room].T.astype(np.float32)
        ids = np.concatenate([keyframe.ids, own_ids])[room]
        self.table.append(Splats(planes), ids, view.index, tracked, reach_m)

    def _news(self, keyframe: Keyframe) -> Keyframe:
        """Return the keyframe without Gaussians that are in the map already or are not finite.

        The latter are counted. A keyframe that is sent again may contain Gaussians that came with
        another one.
        """
        numbers = np.concatenate([keyframe.means, keyframe.normals], axis=1)
        finite = np.isfinite(numbers).all(axis=1)
        self.poisoned += int(np.count_nonzero(~finite))
        self._removed.append(keyframe.ids[~finite])
        keep = finite & ~np.isin(keyframe.ids, self.table.ids)
        return replace(
            keyframe, ids=keyframe.ids[keep], means=keyframe.means[keep],
            normals=keyframe.normals[keep],
        )  # fmt: skip

    def _sigma_z(self, surface: Surface, camera: View) -> NDArray[np.float64]:
        """Return the standard deviation (N,) of the depth of points on a surface, metres."""
        R, t = camera.T_world_cam[:3, :3], camera.T_world_cam[:3, 3]
        return np.asarray(self.config.sensor.sigma((surface.points - t) @ R[:, 2]))

    def step(self, rate: float = 1.0, replay: bool = False) -> float:
        """Take one optimisation step on one view; return its loss.

        `rate` scales the learning rates; with `replay` all views take turns at full resolution.
        Raises `MapperError` before the first keyframe.
        """
        if not self.views:
            raise MapperError('no step without a keyframe: insert one first')
        view, shrink = self._scheduler.choose(self.views, self.config.mapping, replay)
        target = view.target(self._rectify.valid, shrink, self._workers)
        camera = View.of(self.camera, view.T_world_cam, shrink)
        rendering = self._renderer.render(self.table.planes, camera)
        if shrink == 1 and view.visits % _EXPOSURE_INTERVAL == _EXPOSURE_INTERVAL - 1:
            fit = self._exposed(view, rendering, target)
            view.exposure = exposure.blended(view.exposure, fit, self.config.rates.exposure)
        loss = self._losses[shrink]
        background = self._random.random(3, np.float32)  # if fixed, dark surfaces go transparent
        by_image = loss.gradient(rendering.planes, target, view.exposure, background)
        gradients = self._renderer.backward(by_image)
        self.table.step(gradients, self._rates(rate), self._workers)
        if view.index > 0:  # the pose of the first view is fixed: it holds the map in place
            view.turn(gradients.pose, self._pose_rates(rate))
        view.visits += 1
        self.steps += 1
        if self.steps % self.config.mapping.prune_interval == 0:
            self.prune()
            self.table.anchor(np.array([view.T_map_tracked for view in self.views]))
            self._center_exposures()
        return loss.value

    def _exposed(self, view: KeyframeView, rendering: Rendering, target: Target) -> Exposure:
        share = self.config.mapping.exposure_share
        return exposure.fitted(rendering, target.color, target.valid, view.exposure, share)

    def _rates(self, rate: float) -> NDArray[np.float32]:
        r = self.config.rates
        rates = [r.mean_m] * 3 + [r.log_scale] * 3 + [r.rotation] * 4 + [r.opacity]
        return np.array(rates + [r.color / SH_C0] * 3, np.float32) * np.float32(rate)

    def _pose_rates(self, rate: float) -> NDArray[np.float64]:
        return rate * np.repeat([self.config.rates.pose_m, self.config.rates.pose_rad], 3)

    def prune(self) -> None:
        """Drop the Gaussians that the strategy does not keep, and, counted, those not finite."""
        table = self.table
        finite = np.isfinite(table.splats.planes).all(axis=0)
        self.poisoned += int(np.count_nonzero(~finite))
        keep = finite & self._strategy.prune(table, self.views, self.config)
        if not keep.all():
            self._removed.append(table.ids[~keep & (table.ids >= 0)])
            table.keep(keep)

    def correct(self, correction: Correction, others_stay: bool = False) -> int:
        """Move views and Gaussians with their keyframes; to be called between two steps.

        Returns how many views moved: none if the poses are those of now. They are replayed next,
        so that the map is optimised again where parts of it have come together. Keyframes that the
        correction does not name move with the latest named one before them, unless `others_stay`,
        where they are in its world already.
        """
        moves = self._keyframes.correct(correction, others_stay)
        self.revision = correction.revision
        rows = [moves.row(view.reference_ns, view.stamp_ns) for view in self.views]
        moved = moves.moved[rows]
        if not moved.any():
            return 0
        motions, chosen = moves.motions[rows], np.flatnonzero(moved).tolist()
        bent = bend([self.views[k] for k in chosen], motions[chosen])
        in_map = motions.copy()
        for k in chosen:
            in_map[k] = self.views[k].move(motions[k], bent)
        self.table.move(motions, in_map, moved)
        self._scheduler.begin_with(self.views, frozenset(chosen))
        return len(chosen)

    def update(self) -> MapUpdate:
        """Return what changed of the tracker's Gaussians since the last call."""
        columns = self.table.report()
        finite = np.isfinite(self.table.planes[:, columns]).all(axis=0)
        columns = columns[finite]
        normals, flatness = self.table.splats.shape(columns)
        means, normals = self._seen_by_tracker(columns, normals)
        removed = np.concatenate([np.empty(0, np.int64), *self._removed])
        self._removed.clear()
        ids = self.table.ids[columns]
        return MapUpdate(ids, means, normals, flatness, removed, self.revision)

    def _seen_by_tracker(
        self, columns: NDArray[np.int64], normals: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return means and normals (K, 3) in the tracker's world.

        The refined poses of the views stay in the mapper: a mean is given by its motion from where
        its host view saw it.
        """
        table = self.table
        turns = [v.T_tracked[:3, :3] @ v.T_world_cam[:3, :3].T for v in self.views]
        R = np.array(turns).reshape(-1, 3, 3)[table.hosts[columns]]
        moved = table.splats.means[:, columns] - table.anchors[:, columns]
        means = table.measured[:, columns].T + np.einsum('nij,jn->ni', R, moved)
        turned = np.einsum('nij,nj->ni', R, normals)
        return means.astype(np.float32), turned.astype(np.float32)

    def _center_exposures(self) -> None:
        """Move the mean exposure of all views into the map's colours.

        What every view shows stays the same, and the map without exposures is right on average.
        """
        common = exposure.mean([view.exposure for view in self.views])
        self.table.recolor(common)
        for view in self.views:
            view.exposure = view.exposure.relative_to(common)

    def render(self, T_world_cam: NDArray[np.float64]) -> Rendering:
        """Return an image of the map from a pose (4, 4) in the mapper's world."""
        return self._renderer.render(self.table.planes, View.of(self.camera, T_world_cam))

    def corrections(self) -> Corrections:
        """Return the refined poses and exposures, to be interpolated to the other frames."""
        views = sorted(self.views, key=lambda view: view.stamp_ns)  # some may arrive late
        return Corrections(
            np.array([view.stamp_ns for view in views], np.int64),
            np.array([view.T_tracked for view in views]),
            np.array([view.T_world_cam for view in views]),
            [view.exposure for view in views],
        )


def _without_gaussians(posed: PosedFrame) -> Keyframe:
    none = np.empty((0, 3), np.float32)
    return Keyframe(
        posed.frame, posed.T_world_cam, posed.T_cam_cam_at_depth, np.empty(0, np.int64), none, none
    )
