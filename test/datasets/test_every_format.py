# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""One synthetic sequence, written in every format, is tracked equally in all of them.

Wrong axes, units, stamps or intrinsics of any of them would show in the error of the trajectory.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import folders  # type: ignore[import-not-found]
import numpy as np
import pytest
from bags import (  # type: ignore[import-not-found]
    Entry,
    depth_entry,
    image_entry,
    info_entry,
    write_bag,
    write_ros1,
)
from numpy.typing import NDArray
from realsense_bags import pose_entry  # type: ignore[import-not-found]

from dcgs_ros.cli.main import main
from dcgs_ros.core import se3
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.icl_nuim import mirrored
from dcgs_ros.datasets.synthetic.source import SyntheticSource

pytestmark = pytest.mark.slow

FRAMES = 12
ROOM = SyntheticSource.from_address(f'synthetic:room?frames={FRAMES}&sensor=ideal')
CAMERA = ROOM.camera
INTRINSICS = f'{CAMERA.fx},{CAMERA.fy},{CAMERA.cx},{CAMERA.cy}'
MAX_ATE_CM = 0.15  # without an error of the format it is a tenth of that
MOVED_CM = 3.0  # at least, or no error would show

Walk = Sequence[tuple[RgbdFrame, NDArray[np.float64]]]
Written = tuple[Path | str, Sequence[str]]  # an address, and what else has to be told


@pytest.fixture(scope='module')
def walk() -> Walk:
    """Frames and poses T_world_cam."""
    truth = ROOM.groundtruth
    assert truth is not None
    way_cm = 100 * np.linalg.norm(truth.T_world_cam[-1, :3, 3] - truth.T_world_cam[0, :3, 3])
    assert way_cm > MOVED_CM
    return list(zip(ROOM, truth.T_world_cam, strict=True))


def raw(frame: RgbdFrame, per_metre: float) -> NDArray[np.uint16]:
    return np.rint(frame.depth_m * per_metre).astype(np.uint16)


def tum_row(stamp: object, T: NDArray[np.float64]) -> str:
    w, x, y, z = se3.to_quaternion(T)
    return f'{stamp} {" ".join(f"{value:.9f}" for value in (*T[:3, 3], x, y, z, w))}\n'


def as_tum(folder: Path, walk: Walk) -> Written:
    rows: dict[str, str] = {'rgb': '', 'depth': '', 'groundtruth': ''}
    for k, (frame, T) in enumerate(walk):
        stamp = f'{frame.stamp_ns * 1e-9:.9f}'
        folders.write_image(folder / f'rgb/{k}.png', frame.color)
        folders.write_image(folder / f'depth/{k}.png', raw(frame, 5000))
        rows['rgb'] += f'{stamp} rgb/{k}.png\n'
        rows['depth'] += f'{stamp} depth/{k}.png\n'
        rows['groundtruth'] += tum_row(stamp, T)
    for name, text in rows.items():
        (folder / f'{name}.txt').write_text(text)
    return folder, ('--camera', INTRINSICS)


def as_custom(folder: Path, walk: Walk) -> Written:
    as_tum(folder, walk)
    (folder / 'dcgs.yaml').write_text(
        f'camera: {{width: {CAMERA.width}, height: {CAMERA.height}, fx: {CAMERA.fx}, '
        f'fy: {CAMERA.fy}, cx: {CAMERA.cx}, cy: {CAMERA.cy}}}\n'
        'color: rgb/*.png\ndepth: depth/*.png\nrate_hz: 30\ndepth_per_metre: 5000\n'
    )
    truth = (folder / 'groundtruth.txt').read_text().splitlines()
    rows = [f'{k / 30:.9f} {row.partition(" ")[2]}\n' for k, row in enumerate(truth)]
    (folder / 'truth.txt').write_text(''.join(rows))
    return folder, ('--groundtruth', str(folder / 'truth.txt'))


def as_replica(folder: Path, walk: Walk) -> Written:
    for k, (frame, _) in enumerate(walk):
        folders.write_image(folder / f'results/frame{k:06d}.jpg', frame.color)
        folders.write_image(folder / f'results/depth{k:06d}.png', raw(frame, 6553.5))
    (folder / 'traj.txt').write_text(''.join(folders.matrix_row(T) + '\n' for _, T in walk))
    numbers = {'w': CAMERA.width, 'h': CAMERA.height, 'scale': 6553.5}
    numbers |= {key: getattr(CAMERA, key) for key in ('fx', 'fy', 'cx', 'cy')}
    (folder / 'cam_params.json').write_text(json.dumps({'camera': numbers}))
    return folder, ()


def as_scannet(folder: Path, walk: Walk) -> Written:
    for k, (frame, T) in enumerate(walk):
        twice = cv2.resize(frame.color, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
        folders.write_image(folder / f'color/{k}.jpg', np.asarray(twice, np.uint8))
        folders.write_image(folder / f'depth/{k}.png', raw(frame, 1000))
        (folder / 'pose').mkdir(exist_ok=True)
        np.savetxt(folder / f'pose/{k}.txt', T)
    K = np.eye(4)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy
    (folder / 'intrinsic').mkdir()
    np.savetxt(folder / 'intrinsic/intrinsic_depth.txt', K)
    K[:2] *= 2
    K[:2, 2] += 0.5  # edges are scaled, centres lie half a pixel inside of them
    np.savetxt(folder / 'intrinsic/intrinsic_color.txt', K)
    return folder, ()


def as_semantic_nerf(folder: Path, walk: Walk) -> Written:
    for k, (frame, _) in enumerate(walk):
        folders.write_image(folder / f'rgb/rgb_{k}.png', frame.color)
        folders.write_image(folder / f'depth/depth_{k}.png', raw(frame, 1000))
    rows = ''.join(folders.matrix_row(T) + '\n' for _, T in walk)
    (folder / 'traj_w_c.txt').write_text(rows)
    return folder, ('--camera', INTRINSICS)


def as_stray_scanner(folder: Path, walk: Walk) -> Written:
    rows = 'timestamp, frame, x, y, z, qx, qy, qz, qw\n'
    folder.mkdir()
    video = cv2.VideoWriter(
        str(folder / 'rgb.mp4'),
        cv2.VideoWriter.fourcc(*'mp4v'),
        30,
        (2 * CAMERA.width, 2 * CAMERA.height),
    )
    for k, (frame, T) in enumerate(walk):
        bgr = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
        video.write(cv2.resize(bgr, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST))
        folders.write_image(folder / f'depth/{k:06d}.png', raw(frame, 1000))
        stamp, *pose = tum_row(f'{frame.stamp_ns * 1e-9:.9f}', T).split()
        rows += ', '.join([stamp, f'{k:06d}', *pose]) + '\n'
    video.release()
    (folder / 'odometry.csv').write_text(rows)
    fx, fy, cx, cy = 2 * CAMERA.fx, 2 * CAMERA.fy, 2 * CAMERA.cx + 0.5, 2 * CAMERA.cy + 0.5
    (folder / 'camera_matrix.csv').write_text(f'{fx}, 0, {cx}\n0, {fy}, {cy}\n0, 0, 1\n')
    return folder, ()


def as_stamped_names(folder: Path, walk: Walk) -> Written:
    written = as_tum(folder, walk)
    for kind in ('rgb', 'depth'):
        for k, (frame, _) in enumerate(walk):
            path = folder / f'{kind}/{k}.png'
            path.rename(path.with_name(f'{frame.stamp_ns * 1e-9:.9f}.png'))
        (folder / f'{kind}.txt').unlink()
    return written


def as_icl_nuim(folder: Path, walk: Walk) -> Written:
    folder = folder.with_name('living_room_traj0_frei_png')
    rows = truth = ''
    for k, (frame, T) in enumerate(walk):
        folders.write_image(folder / f'rgb/{k}.png', frame.color)
        folders.write_image(folder / f'depth/{k}.png', raw(frame, 5000))
        rows += f'{k} depth/{k}.png {k} rgb/{k}.png\n'
        truth += tum_row(k, mirrored(T))
    (folder / 'associations.txt').write_text(rows)
    (folder / 'livingRoom0.gt.freiburg').write_text(truth)
    return folder, ('--camera', INTRINSICS)


def entries(walk: Walk) -> list[Entry]:
    color, optical = '/camera/camera/color/image_raw', 'camera_color_optical_frame'
    found: list[Entry] = []
    for frame, T in walk:
        found += [
            info_entry(frame.stamp_ns, CAMERA),
            image_entry(color, frame.stamp_ns, 'rgb8', frame.color, optical),
            depth_entry(frame.stamp_ns, raw(frame, 1000)),
            pose_entry(frame.stamp_ns, T),
        ]
    return found


def as_rosbag2(folder: Path, walk: Walk) -> Written:
    return next(write_bag(folder, entries(walk)).glob('*.mcap')), ()


def as_ros1(folder: Path, walk: Walk) -> Written:
    return write_ros1(folder.with_suffix('.bag'), entries(walk)), ()


WRITERS: list[Callable[[Path, Walk], Written]] = [
    as_tum, as_custom, as_replica, as_scannet, as_icl_nuim, as_rosbag2, as_ros1,
    as_semantic_nerf, as_stray_scanner, as_stamped_names,
]  # fmt: skip


@pytest.mark.parametrize('write', WRITERS, ids=lambda write: write.__name__)
def test_the_walk_is_tracked_in_every_format(
    tmp_path: Path, walk: Walk, write: Callable[[Path, Walk], Written]
) -> None:
    source, options = write(tmp_path / 'room', walk)
    camera = options if options[:1] == ('--camera',) else ()
    assert main(['info', str(source), *camera]) == 0
    out = tmp_path / 'run'
    assert main(['run', str(source), '--no-mapping', '--out', str(out), *options]) == 0
    report = json.loads((out / 'report.json').read_text())
    assert report['tracked'] == FRAMES
    assert report['ate']['rmse_cm'] < MAX_ATE_CM

    # ... and so is what it is converted to.
    assert main(['convert', str(source), str(tmp_path / 'bag'), *options]) == 0
    again = tmp_path / 'again'
    assert main(['run', str(tmp_path / 'bag'), '--no-mapping', '--out', str(again)]) == 0
    ours, theirs = ((folder / 'trajectory.tum').read_bytes() for folder in (out, again))
    assert ours == theirs


def test_seven_scenes_is_tracked(tmp_path: Path) -> None:
    wall = np.full((480, 640), 1500, np.uint16)
    folder = folders.write_seven_scenes(tmp_path / 'seq-01', [wall] * 3)
    assert main(['info', str(folder)]) == 0
    assert main(['run', str(folder), '--no-mapping', '--out', str(tmp_path / 'run')]) == 0
    report = json.loads((tmp_path / 'run' / 'report.json').read_text())
    assert report['frames'] == 3 and report['tracked'] >= 1
