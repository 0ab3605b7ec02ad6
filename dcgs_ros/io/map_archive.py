# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A whole map in one archive: what tracker and mapper need to resume, or to localise in it."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..core.camera import PinholeCamera
from ..core.config.schema import flatten, override
from ..core.config.stages import Config
from ..core.errors import DcgsError
from ..core.mapping.splats import Splats
from .archive import Archive, ArchiveError, read_archive, write_archive

# Fields of `SavedMap` that are arrays of the same name in the file.
_ARRAYS = (
    'ids', 'hosts', 'viewpoints', 'track_covariances', 'landmarks', 'landmark_covariances',
)  # fmt: skip

_Part = TypeVar('_Part')


class MapFileError(DcgsError):
    """The parts of a map do not fit each other, or its file cannot be read or written."""


@dataclass(frozen=True)
class SavedKeyframe:
    """One keyframe, its images encoded as JPEG and PNG."""

    stamp_ns: int  # of the colour image
    T_tracked: NDArray[np.float64]  # (4, 4) T_world_cam of the tracker
    T_world_cam: NDArray[np.float64]  # (4, 4) of the mapper
    exposure: NDArray[np.float32]  # (2, 3) gain and offset of red, green, blue
    color_jpeg: bytes
    depth_png: bytes

    def __post_init__(self) -> None:
        """Check shapes, types and finiteness."""
        if not -(2**63) <= self.stamp_ns < 2**63:
            raise MapFileError(f'stamp {self.stamp_ns} ns of a keyframe does not fit 64 bits')
        _check('T_tracked', self.T_tracked, np.float64, (4, 4))
        _check('T_world_cam', self.T_world_cam, np.float64, (4, 4))
        _check('exposure', self.exposure, np.float32, (2, 3))
        for name in ('T_tracked', 'T_world_cam', 'exposure'):
            if not np.isfinite(getattr(self, name)).all():
                raise MapFileError(f'{name} of the keyframe at {self.stamp_ns} ns is not finite')


@dataclass(frozen=True)
class SavedMap:
    """N Gaussians with both covariances, L landmarks, and the keyframes that spawned them."""

    camera: PinholeCamera
    config: Config
    splats: Splats
    ids: NDArray[np.int64]  # (N,) negative for those that the mapper spawned
    hosts: NDArray[np.int32]  # (N,) index of the keyframe that spawned each
    # (N, 3) optical centre of the last observation, metres, world, which gives Sigma_t. NaN for
    # Gaussians that the tracker does not have, or no longer has.
    viewpoints: NDArray[np.float32]
    # (N, 6) Sigma_t: xx xy xz yy yz zz, square metres, world. NaN for the same Gaussians.
    track_covariances: NDArray[np.float32]
    landmarks: NDArray[np.float64]  # (L, 3) metres, world
    landmark_covariances: NDArray[np.float64]  # (L, 3, 3) square metres, world
    keyframes: tuple[SavedKeyframe, ...]

    def __post_init__(self) -> None:
        """Check that the parts fit each other; raises `MapFileError` naming one that does not."""
        n, landmarks = len(self.splats), self.landmarks.size // 3
        _check('ids', self.ids, np.int64, (n,))
        _check('hosts', self.hosts, np.int32, (n,))
        _check('viewpoints', self.viewpoints, np.float32, (n, 3))
        _check('track_covariances', self.track_covariances, np.float32, (n, 6))
        _check('landmarks', self.landmarks, np.float64, (landmarks, 3))
        _check('landmark_covariances', self.landmark_covariances, np.float64, (landmarks, 3, 3))
        self._check_references()
        self._check_numbers()

    def _check_references(self) -> None:
        n, keyframes = len(self.ids), len(self.keyframes)
        different = len(np.unique(self.ids))
        if different != n:
            raise MapFileError(f'{n} Gaussians have only {different} different ids')
        homeless = np.flatnonzero((self.hosts < 0) | (self.hosts >= keyframes))
        if len(homeless):
            raise MapFileError(
                f'hosts of {len(homeless)} of {n} Gaussians, the first {self.hosts[homeless[0]]}, '
                f'are none of the {keyframes} keyframes'
            )

    def _check_numbers(self) -> None:
        _check_finite('splats', self.splats.planes.T)
        _check_finite('landmarks', self.landmarks)
        _check_finite('landmark_covariances', self.landmark_covariances)
        measured = self.measured
        _check_finite('viewpoints', self.viewpoints[measured])
        _check_finite('track_covariances', self.track_covariances[measured])
        own = np.count_nonzero(measured & (self.ids < 0))
        if own:
            raise MapFileError(f'{own} Gaussians that the mapper spawned have viewpoints')

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which Gaussians (N,) the tracker has, with a tracking covariance."""
        missing = np.isnan(self.viewpoints).all(axis=1) & np.isnan(self.track_covariances).all(
            axis=1
        )
        return np.asarray(~missing)


def write_map(path: Path | str, saved: SavedMap) -> None:
    """Write a map; the file is written completely or not at all.

    Raises `MapFileError` if it cannot be written.
    """
    keyframes = saved.keyframes
    arrays: dict[str, NDArray[Any]] = {'splats': saved.splats.planes}
    arrays |= {name: getattr(saved, name) for name in _ARRAYS}
    arrays['stamps_ns'] = np.array([k.stamp_ns for k in keyframes], np.int64)
    arrays['tracked'] = np.array([k.T_tracked for k in keyframes]).reshape(-1, 4, 4)
    arrays['poses'] = np.array([k.T_world_cam for k in keyframes]).reshape(-1, 4, 4)
    arrays['exposures'] = np.array([k.exposure for k in keyframes], np.float32).reshape(-1, 2, 3)
    blobs: dict[str, bytes] = {}
    for index, keyframe in enumerate(keyframes):
        blobs[_color_name(index)] = keyframe.color_jpeg
        blobs[_depth_name(index)] = keyframe.depth_png
    metadata = {'camera': dataclasses.asdict(saved.camera), 'config': flatten(saved.config)}
    try:
        write_archive(path, arrays, metadata, blobs)
    except ArchiveError as error:
        raise MapFileError(str(error)) from error


def read_map(path: Path | str) -> SavedMap:
    """Read a map exactly as it was written.

    Settings that the file does not have get their defaults. Raises `MapFileError` naming the file
    and what is wrong with it: not an archive, a part that is missing or does not fit the others, a
    setting that does not exist, numbers that are not finite.
    """
    try:
        return _assemble(read_archive(path))
    except ArchiveError as error:
        raise MapFileError(str(error)) from error
    except DcgsError as error:
        raise MapFileError(f'{path}: {error}') from error


def _assemble(archive: Archive) -> SavedMap:
    config = _part(archive.metadata, 'config')
    if not isinstance(config, dict):
        raise MapFileError(f'config is a {type(config).__name__}, not settings')
    return SavedMap(
        camera=_camera(_part(archive.metadata, 'camera')),
        config=override(Config(), config),
        splats=Splats(_part(archive.arrays, 'splats')),
        keyframes=_keyframes(archive),
        **{name: _part(archive.arrays, name) for name in _ARRAYS},
    )


def _camera(fields: Any) -> PinholeCamera:
    try:
        width, height = (operator.index(fields[name]) for name in ('width', 'height'))
        fx, fy, cx, cy = (float(fields[name]) for name in ('fx', 'fy', 'cx', 'cy'))
        distortion = tuple(float(number) for number in fields['distortion'])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise MapFileError(f'camera is not usable: {type(error).__name__}: {error}') from error
    return PinholeCamera(width, height, fx, fy, cx, cy, distortion)


def _keyframes(archive: Archive) -> tuple[SavedKeyframe, ...]:
    stamps, tracked, poses, exposures = (
        _part(archive.arrays, name) for name in ('stamps_ns', 'tracked', 'poses', 'exposures')
    )
    n = stamps.size
    _check('stamps_ns', stamps, np.int64, (n,))
    _check('tracked', tracked, np.float64, (n, 4, 4))
    _check('poses', poses, np.float64, (n, 4, 4))
    _check('exposures', exposures, np.float32, (n, 2, 3))
    return tuple(
        SavedKeyframe(
            int(stamps[k]), tracked[k], poses[k], exposures[k],
            _part(archive.blobs, _color_name(k)), _part(archive.blobs, _depth_name(k)),
        )
        for k in range(n)
    )  # fmt: skip


def _color_name(keyframe: int) -> str:
    return f'color_{keyframe:06d}.jpg'


def _depth_name(keyframe: int) -> str:
    return f'depth_{keyframe:06d}.png'


def _part(parts: Mapping[str, _Part], name: str) -> _Part:
    if name not in parts:
        raise MapFileError(f'holds no {name!r}')
    return parts[name]


def _check(name: str, array: NDArray[Any], dtype: DTypeLike, shape: tuple[int, ...]) -> None:
    if array.dtype != dtype or array.shape != shape:
        raise MapFileError(
            f'{name} is {array.dtype} of shape {array.shape}, not {np.dtype(dtype)} of {shape}'
        )


def _check_finite(name: str, rows: NDArray[np.floating]) -> None:
    """Check that all of `rows` (M, ...) are finite; raises `MapFileError`."""
    bad = np.count_nonzero(~np.isfinite(rows).all(axis=tuple(range(1, rows.ndim))))
    if bad:
        raise MapFileError(f'{name}: {bad} of {len(rows)} are not finite')
