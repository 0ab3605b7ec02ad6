# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs render`: a map from the poses of a trajectory."""

from __future__ import annotations

import contextlib
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
from ..evaluation.map_view import corrections
from ..io.map_archive import MapFileError, SavedMap, read_map
from ..io.ply import PlyError, read_ply
from ..io.trajectory import read_tum
from .arguments import RenderArguments, UsageError
from .pictures import CODECS, ImageFolder, Pictures, Video
from .run.outputs import FolderError, create_folder, refuse_used

Pose = NDArray[np.float64]  # (4, 4) T_world_cam

_MAX_SIDE_PX = 8192
_RATES_HZ = (1.0, 120.0)  # of a video


@dataclass(frozen=True)
class _Scene:
    splats: Splats
    camera: PinholeCamera
    pose: Callable[[int, Pose], Pose]  # in the map's world, by stamp and as tracked


def execute(arguments: RenderArguments) -> int:
    """Render every pose."""
    _check_out(arguments)
    scene, trajectory = _scene(arguments), read_tum(arguments.trajectory)
    poses = zip(trajectory.stamps_ns.tolist(), trajectory.T_world_cam, strict=True)
    with closing(Workers(cores())) as workers, _pictures(arguments, trajectory) as pictures:
        renderer = make_renderer(workers)
        for stamp_ns, T in tqdm(poses, total=len(trajectory), unit='view', disable=None):
            view = View.of(scene.camera, scene.pose(stamp_ns, T))
            pictures.add(renderer.render(scene.splats.planes, view))
    print(f'{len(trajectory)} views of {arguments.map}: {pictures.path}')
    return 0


def _check_out(arguments: RenderArguments) -> None:
    """Refuse what would be overwritten, and depth in a video."""
    out = arguments.out
    if out is None:
        return
    if out.suffix.lower() not in CODECS:
        refuse_used(out)
    elif out.exists():
        raise FolderError(f'{out} exists: no file is overwritten')
    elif arguments.depth:
        raise UsageError(f'--depth needs a folder for its images, {out} is a video')


def _scene(arguments: RenderArguments) -> _Scene:
    """Read the map; what a .ply lacks the arguments have to tell."""
    path, camera = arguments.map, _camera(arguments)
    if path.suffix.lower() != '.ply':
        saved = read_map(path)
        return _Scene(saved.splats, camera or saved.camera, _corrected(path, saved))
    splats = read_ply(path)
    if not len(splats):
        raise PlyError(f'{path}: holds no Gaussian')
    if camera is None:
        raise UsageError(f'{path} knows no camera: give --camera, with --size if it is numbers')
    return _Scene(splats, camera, lambda _, T_tracked: T_tracked)


def _corrected(path: Path, saved: SavedMap) -> Callable[[int, Pose], Pose]:
    """Correct what was tracked while the map was made, and nothing before or after."""
    try:
        by_time = corrections(saved)
    except MapFileError as error:
        raise MapFileError(f'{path}: {error}') from None
    first_ns, last_ns = (saved.keyframes[k].stamp_ns for k in (0, -1))

    def pose(stamp_ns: int, T_tracked: Pose) -> Pose:
        within = first_ns <= stamp_ns <= last_ns
        return by_time.pose(stamp_ns, T_tracked) if within else T_tracked

    return pose


def _camera(arguments: RenderArguments) -> PinholeCamera | None:
    """Understand --camera and --size; None without."""
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
    """Open the video, or create the folder, which is not left behind empty."""
    out = arguments.out
    if out is not None and out.suffix.lower() in CODECS:
        out.parent.mkdir(parents=True, exist_ok=True)
        with closing(Video(out, _rate_hz(trajectory))) as video:
            yield video
        return
    folder = create_folder(out, arguments.map.stem)
    try:
        yield ImageFolder(folder, arguments.depth)
    finally:
        with contextlib.suppress(OSError):  # which says that it is not empty, as it should be
            folder.rmdir()


def _rate_hz(trajectory: Trajectory) -> float:
    """Take the trajectory's median rate, as far as it makes a video."""
    intervals_s = 1e-9 * np.diff(trajectory.stamps_ns)
    interval_s = float(np.median(intervals_s)) if len(intervals_s) else 0.0
    return float(np.clip(1 / max(interval_s, 1e-9), *_RATES_HZ))
