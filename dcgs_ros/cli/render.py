# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs render`: render a map along a trajectory."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ..core.camera import PinholeCamera
from ..core.kernels.workers import Workers, cores
from ..core.mapping.splats import Splats
from ..core.render import make_renderer
from ..core.render.renderer import View
from ..core.trajectory import Trajectory
from ..datasets.camera_presets import PRESETS
from ..datasets.parsing.intrinsics import parse_intrinsics
from ..evaluation.map_view import read_corrections
from ..io.map_archive import MapFileError, SavedMap, read_map
from ..io.trajectory import read_tum
from .arguments import RenderArguments, UsageError
from .folders import FolderError, new_folder, refuse_used
from .maps import is_splats, read_splats
from .pictures import CODECS, ImageFolder, Pictures, Video

Pose = NDArray[np.float64]  # (4, 4) T_world_cam

_MAX_SIDE_PX = 8192
_RATES_HZ = (1.0, 120.0)  # of a video


@dataclass(frozen=True)
class _MapToRender:
    splats: Splats
    camera: PinholeCamera
    pose: Callable[[int, Pose], Pose]  # (stamp_ns, T_tracked) -> T_world_cam in the map's world


def execute(arguments: RenderArguments) -> int:
    """Render every pose and return the exit status."""
    _check_out(arguments)
    to_render, trajectory = _read(arguments), read_tum(arguments.trajectory)
    poses = zip(trajectory.stamps_ns.tolist(), trajectory.T_world_cam, strict=True)
    with closing(Workers(cores())) as workers, _pictures(arguments, trajectory) as pictures:
        renderer = make_renderer(workers)
        for stamp_ns, T in tqdm(poses, total=len(trajectory), unit='view', disable=None):
            view = View.of(to_render.camera, to_render.pose(stamp_ns, T))
            pictures.add(renderer.render(to_render.splats.planes, view))
    print(f'{len(trajectory)} views of {arguments.map}: {pictures.path}')
    return 0


def _check_out(arguments: RenderArguments) -> None:
    """Raise `FolderError` or `UsageError` if --out exists or cannot hold what is asked for."""
    out = arguments.out
    if out is None:
        return
    if out.suffix.lower() not in CODECS:
        refuse_used(out)
    elif out.exists():
        raise FolderError(f'{out} exists: no file is overwritten')
    elif arguments.depth:
        raise UsageError(f'--depth needs a folder for its images, {out} is a video')


def _read(arguments: RenderArguments) -> _MapToRender:
    """Read the map; raise `UsageError` for a .ply or .spz without --camera."""
    path, camera = arguments.map, _camera(arguments)
    if not is_splats(path):
        saved = read_map(path)
        return _MapToRender(saved.splats, camera or saved.camera, _corrected(path, saved))
    splats = read_splats(path)
    if camera is None:
        raise UsageError(f'{path} holds no camera: give --camera, with --size if it is numbers')
    return _MapToRender(splats, camera, lambda _, T_tracked: T_tracked)


def _corrected(path: Path, saved: SavedMap) -> Callable[[int, Pose], Pose]:
    """Return a function that corrects poses between the first and the last keyframe."""
    try:
        corrections = read_corrections(saved)
    except MapFileError as error:
        raise MapFileError(f'{path}: {error}') from None
    first_ns, last_ns = (saved.keyframes[k].stamp_ns for k in (0, -1))

    def pose(stamp_ns: int, T_tracked: Pose) -> Pose:
        within = first_ns <= stamp_ns <= last_ns
        return corrections.pose(stamp_ns, T_tracked) if within else T_tracked

    return pose


def _camera(arguments: RenderArguments) -> PinholeCamera | None:
    """Return the camera that --camera and --size describe, or None without --camera."""
    text, size = arguments.camera, arguments.size
    if text in PRESETS or text is None:
        if size is not None:
            raise UsageError(f'--size {size} goes with --camera fx,fy,cx,cy')
        return None if text is None else PRESETS[text].camera
    numbers = re.fullmatch(r'([0-9]{1,6})[xX]([0-9]{1,6})', size or '')
    if numbers is None:
        raise UsageError(f'--camera {text} needs --size WIDTHxHEIGHT, not {size}')
    width, height = (int(number) for number in numbers.groups())
    if max(width, height) > _MAX_SIDE_PX:
        raise UsageError(f'--size {size}: more than {_MAX_SIDE_PX} pixels a side')
    return parse_intrinsics(text, width, height)


@contextmanager
def _pictures(arguments: RenderArguments, trajectory: Trajectory) -> Iterator[Pictures]:
    """Open the video or create the folder."""
    out = arguments.out
    if out is not None and out.suffix.lower() in CODECS:
        out.parent.mkdir(parents=True, exist_ok=True)
        with closing(Video(out, _rate_hz(trajectory))) as video:
            yield video
        return
    with new_folder(out, arguments.map.stem) as folder:
        yield ImageFolder(folder, arguments.depth)


def _rate_hz(trajectory: Trajectory) -> float:
    """Return the trajectory's median rate, within what a video can have."""
    intervals_s = 1e-9 * np.diff(trajectory.stamps_ns)
    interval_s = float(np.median(intervals_s)) if len(intervals_s) else 0.0
    return float(np.clip(1 / max(interval_s, 1e-9), *_RATES_HZ))
