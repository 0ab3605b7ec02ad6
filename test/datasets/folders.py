# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Small folders in the layouts of the datasets, and damaged copies of their files."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.errors import DcgsError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.images.sequence import ImageSequence

CAMERA = PinholeCamera(64, 48, 50.0, 51.0, 31.5, 23.5)
NUMBERS_JSON = {'w': 64, 'h': 48, 'fx': 50.0, 'fy': 51.0, 'cx': 31.5, 'cy': 23.5, 'scale': 6553.5}
POSE_TOLERANCE = 1e-8  # of matrices that were written with all their digits


def pose_of(k: int) -> NDArray[np.float64]:
    """Return T_world_cam (4, 4) of frame k of a camera that turns and moves."""
    return se3.exp(np.array([0.1 * k, -0.05, 0.02 * k, 0.03 * k, 0.2, -0.1]))


def color_of(k: int, size: tuple[int, int] = (64, 48)) -> NDArray[np.uint8]:
    """Return RGB (H, W, 3) that differs from frame to frame."""
    color = np.empty((size[1], size[0], 3), np.uint8)
    color[:] = (10 * k, 100, 200)
    return color


def write_image(path: Path, image: NDArray[Any]) -> None:
    """Encode RGB (H, W, 3) or depth (H, W) by the path's suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    encoded, data = cv2.imencode(path.suffix, image[..., ::-1] if image.ndim == 3 else image)
    assert encoded
    path.write_bytes(data.tobytes())


def matrix_row(T: NDArray[np.float64]) -> str:
    return ' '.join(repr(float(value)) for value in T.ravel())


def write_replica(
    scene: Path, numbers: Iterable[int], poses: Sequence[NDArray[np.float64]]
) -> Path:
    """Write frames of these numbers at (1 + k / 10) m, `cam_params.json` beside the scene."""
    for k in numbers:
        write_image(scene / f'results/frame{k:06d}.jpg', color_of(k))
        depth = np.full((48, 64), round(6553.5 * (1 + 0.1 * k)), np.uint16)
        write_image(scene / f'results/depth{k:06d}.png', depth)
    (scene / 'traj.txt').write_text(''.join(matrix_row(T) + '\n' for T in poses))
    (scene.parent / 'cam_params.json').write_text(json.dumps({'camera': NUMBERS_JSON}))
    return scene


def write_seven_scenes(folder: Path, depths_mm: Sequence[NDArray[np.uint16]]) -> Path:
    """Write frames of 640x480 with these depths; pose k is `pose_of(k)`, of the depth camera."""
    for k, depth_mm in enumerate(depths_mm):
        write_image(folder / f'frame-{k:06d}.color.png', color_of(k, (640, 480)))
        write_image(folder / f'frame-{k:06d}.depth.png', depth_mm)
        rows = ['\t'.join(repr(float(value)) for value in row) for row in pose_of(k)]
        (folder / f'frame-{k:06d}.pose.txt').write_text('\n'.join(rows) + '\n')
    return folder


def write_icl_nuim(folder: Path, numbers: Sequence[int], truth: str | None) -> Path:
    """Write frames of these numbers at (1 + k / 10) m, `truth` in livingRoom2.gt.freiburg."""
    for k in numbers:
        write_image(folder / f'rgb/{k}.png', color_of(k))
        depth = np.full((48, 64), 5000 + 500 * k, np.uint16)
        write_image(folder / f'depth/{k}.png', depth)
    rows = [f'{k} depth/{k}.png {k} rgb/{k}.png\n' for k in numbers]
    (folder / 'associations.txt').write_text(''.join(rows))
    if truth is not None:
        (folder / 'livingRoom2.gt.freiburg').write_text(truth)
    return folder


def write_custom(folder: Path, text: str, colors: Sequence[str], depths: Sequence[str]) -> Path:
    """Write images of these names: colour `color_of(k)`, depth k + 1 m in millimetres."""
    for k, name in enumerate(colors):
        write_image(folder / name, color_of(k))
    for k, name in enumerate(depths):
        write_image(folder / name, np.full((48, 64), 1000 * (k + 1), np.uint16))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / 'dcgs.yaml').write_text(text)
    return folder


def good_frames(source: ImageSequence) -> list[RgbdFrame]:
    frames = list(source)
    assert all(isinstance(frame, RgbdFrame) for frame in frames), frames
    return [frame for frame in frames if isinstance(frame, RgbdFrame)]


def mutants(data: bytes, count: int, seed: int) -> Iterable[bytes]:
    """Yield damaged copies of a text file: bytes, lengths, numbers, nesting, invalid text."""
    rng = np.random.default_rng(seed)
    spice = [b'{', b'[', b']', b'}', b'&a [*a]', b'1' * 5000, b'-1e400', b'.inf', b'nan', b'\0']
    spice += [b'!!int ""', b'!!bool x', b'!!timestamp x', b'!!python/name:os.system', b'"\\ud800"']
    spice += [b'../..', b'[' * 3000, b'{"a":' * 2000, b'\xff\xfe', b'\n- ', b'0x' + b'f' * 5000]
    spice += [b'-', b': ', b'2001-99-99', b'"\\0"', b'**/**', b'a/' * 2000, b'#', b'\t', b'null']
    words = [match.span() for match in re.finditer(rb'[^\s:,]+', data)]
    for k in range(count):
        start, end = words[rng.integers(len(words))]
        cut = int(rng.integers(len(data)))
        piece = spice[rng.integers(len(spice))]
        yield [
            data[:start] + piece + data[end:],
            data[:cut] + piece + data[cut:],
            data[:cut],
            data[:cut] + bytes([rng.integers(256)]) + data[cut + 1 :],
            rng.bytes(cut),
        ][k % 5]


def survives(path: Path, damaged: Iterable[bytes], open_: Callable[[], ImageSequence]) -> int:
    """Open each damaged file and read a frame; return how many could be opened.

    Only a `DcgsError` may be raised, whose message can be printed and is not much longer than the
    file.
    """
    opened = 0
    for data in damaged:
        path.write_bytes(data)
        try:
            source = open_()
        except DcgsError as error:
            message = str(error)
            message.encode()
            assert len(message) < 1000 + len(data), message[:1000]
        except Exception as error:
            pytest.fail(f'{data[:300]!r}: {error!r}')
        else:
            opened += 1
            next(iter(source))
    return opened
