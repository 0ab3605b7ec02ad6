# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs render` writes what the renderer shows, and overwrites nothing."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from running import SMALL_CAMERA, SMALL_FRAMES, Run  # type: ignore[import-not-found]

from dcgs_ros.cli.main import main
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.mapping.splats import PLANES, Splats
from dcgs_ros.core.render.cpu import CpuRenderer
from dcgs_ros.core.render.renderer import Rendering, View
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.io.map_archive import SavedMap, read_map, write_map
from dcgs_ros.io.ply import write_ply
from dcgs_ros.io.trajectory import read_tum, write_tum

CAMERA = ('--camera', '131.25,131.25,79.5,59.5', '--size', '160x120')
LEVEL = 1  # of 255: poses are rounded to nine decimals
MILLIMETRE = 1
SPZ_LEVELS = 3  # mean error of SPZ's eight bits
VIDEO_LEVELS = 12  # largest mean error of a video codec

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('small_images')]


@pytest.fixture
def saved(mapped: Run) -> SavedMap:
    return read_map(mapped.folder / 'map.dcgs')


def words_of(mapped: Run, out: Path, name: str = 'map.dcgs') -> list[str]:
    files = [str(mapped.folder / name), '--trajectory', str(mapped.folder / 'trajectory.tum')]
    return ['render', *files, '--out', str(out)]


def rendered(
    saved: SavedMap, T_world_cam: NDArray[np.float64], camera: PinholeCamera | None = None
) -> Rendering:
    view = View.of(camera or saved.camera, T_world_cam)
    return CpuRenderer(Workers(1)).render(saved.splats.planes, view)


def bgr_of(rendering: Rendering) -> NDArray[np.uint8]:
    rgb = np.rint(255 * np.clip(rendering.color, 0, 1)).astype(np.uint8)
    return np.moveaxis(rgb, 0, -1)[..., ::-1]


def difference(image: NDArray[np.uint8], other: NDArray[np.uint8]) -> int:
    return int(np.abs(image.astype(int) - other.astype(int)).max())


def test_every_pose_gives_an_image_and_keyframes_look_as_the_mapper_has_them(
    mapped: Run, saved: SavedMap, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words_of(mapped, tmp_path / 'out')) == 0
    assert str(tmp_path / 'out') in capsys.readouterr().out
    names = [f'{k:06d}.png' for k in range(SMALL_FRAMES)]
    assert sorted(path.name for path in (tmp_path / 'out').iterdir()) == names
    stamps_ns = read_tum(mapped.folder / 'trajectory.tum').stamps_ns
    for keyframe in saved.keyframes:
        k = int(np.searchsorted(stamps_ns, keyframe.stamp_ns))
        image = cv2.imread(str(tmp_path / 'out' / names[k]))
        assert difference(image, bgr_of(rendered(saved, keyframe.T_world_cam))) <= LEVEL


def test_poses_beyond_the_keyframes_are_not_corrected(
    mapped: Run, saved: SavedMap, tmp_path: Path
) -> None:
    keyframe = saved.keyframes[-1]
    assert not np.allclose(keyframe.T_world_cam, keyframe.T_tracked, atol=1e-6)
    for shift_ns, T_world_cam in ((0, keyframe.T_world_cam), (1, keyframe.T_tracked)):
        stamps_ns = np.array([keyframe.stamp_ns + shift_ns])
        poses = Trajectory(stamps_ns, keyframe.T_tracked[None])
        write_tum(tmp_path / 'pose.tum', poses)
        words = [str(mapped.folder / 'map.dcgs'), '--trajectory', str(tmp_path / 'pose.tum')]
        assert main(['render', *words, '--out', str(tmp_path / str(shift_ns))]) == 0
        image = cv2.imread(str(tmp_path / str(shift_ns) / '000000.png'))
        assert difference(image, bgr_of(rendered(saved, T_world_cam))) <= LEVEL


def test_a_ply_is_seen_with_the_camera_given(mapped: Run, saved: SavedMap, tmp_path: Path) -> None:
    assert main([*words_of(mapped, tmp_path / 'out', 'map.ply'), *CAMERA]) == 0
    T_tracked = read_tum(mapped.folder / 'trajectory.tum').T_world_cam[3]
    image = cv2.imread(str(tmp_path / 'out' / '000003.png'))
    assert difference(image, bgr_of(rendered(saved, T_tracked, SMALL_CAMERA))) <= LEVEL


def test_an_spz_is_seen_like_the_map_that_it_was_made_of(mapped: Run, tmp_path: Path) -> None:
    spz = tmp_path / 'map.spz'
    assert main(['convert', str(mapped.folder / 'map.dcgs'), str(spz)]) == 0
    words = ['--trajectory', str(mapped.folder / 'trajectory.tum'), *CAMERA]
    for path in (spz, mapped.folder / 'map.ply'):
        assert main(['render', str(path), *words, '--out', str(tmp_path / path.suffix[1:])]) == 0
    images = [cv2.imread(str(tmp_path / kind / '000003.png')) for kind in ('spz', 'ply')]
    assert np.abs(images[0].astype(float) - images[1]).mean() < SPZ_LEVELS


def test_depth_is_in_millimetres_where_something_is_seen(
    mapped: Run, saved: SavedMap, tmp_path: Path
) -> None:
    assert main([*words_of(mapped, tmp_path / 'out'), '--depth']) == 0
    assert len(list((tmp_path / 'out').iterdir())) == 2 * SMALL_FRAMES
    depth_mm = cv2.imread(str(tmp_path / 'out' / '000000_depth.png'), cv2.IMREAD_UNCHANGED)
    assert depth_mm.dtype == np.uint16
    rendering = rendered(saved, saved.keyframes[0].T_world_cam)
    opaque = rendering.transmittance < 0.1
    expected_mm = 1000 * rendering.depth[opaque] / (1 - rendering.transmittance[opaque])
    assert np.abs(depth_mm[opaque] - expected_mm).max() <= MILLIMETRE
    assert (depth_mm[rendering.transmittance > 0.6] == 0).all()


@pytest.mark.parametrize('suffix', ['.mp4', '.avi'])
def test_a_video_has_the_frames_at_the_trajectorys_rate(
    mapped: Run, saved: SavedMap, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / 'new' / f'video{suffix}'
    assert main(words_of(mapped, path)) == 0
    video = cv2.VideoCapture(str(path))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == SMALL_FRAMES
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(30, abs=0.1)
    _, image = video.read()
    expected = bgr_of(rendered(saved, saved.keyframes[0].T_world_cam))
    assert np.abs(image.astype(int) - expected.astype(int)).mean() < VIDEO_LEVELS
    video.release()


def test_without_a_name_it_goes_to_a_new_numbered_folder(
    mapped: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        assert main(words_of(mapped, tmp_path)[:-2]) == 0
        assert (tmp_path / 'runs' / f'map-{number}' / '000009.png').exists()


def refusal(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    lines = [line for line in captured.err.splitlines() if line.startswith('dcgs: ')]
    assert len(lines) == 1
    return lines[0]


def test_nothing_is_overwritten(
    mapped: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ('video.mp4', 'file'):
        (tmp_path / name).write_text('mine')
        assert str(tmp_path / name) in refusal(words_of(mapped, tmp_path / name), capsys)
        assert (tmp_path / name).read_text() == 'mine'
    assert 'not empty' in refusal(words_of(mapped, tmp_path), capsys)


@pytest.mark.parametrize(
    ('name', 'words', 'reason'),
    [
        ('map.ply', [], 'give --camera'),
        ('map.ply', ['--camera', 'fr9'], '--size'),
        ('map.ply', ['--camera', 'fr9', '--size', '160x120'], "camera 'fr9'"),
        ('map.ply', ['--camera', '1,2,3,4', '--size', '0x0'], 'smaller than'),
        ('map.ply', ['--camera', '1,2,3,4', '--size', '90000x90000'], 'more than 8192'),
        ('map.ply', ['--camera', '1,2,3,4', '--size', 'big'], 'not big'),
        ('map.ply', ['--camera', '-1,2,3,4', '--size', '160x120'], 'not usable'),
        ('map.dcgs', ['--size', '160x120'], '--size 160x120 goes with'),
        ('map.dcgs', ['--camera', 'fr1', '--size', '160x120'], '--size 160x120 goes with'),
        ('nothing.dcgs', [], 'nothing.dcgs: cannot be read'),
        ('nothing.ply', [*CAMERA], 'nothing.ply: cannot be read'),
        ('report.json', [], 'report.json'),
        ('map.dcgs', ['--trajectory', 'no.tum'], 'no.tum: cannot be read'),
        ('map.dcgs', ['--out', 'video.mp4', '--depth'], '--depth needs a folder'),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(
    mapped: Run,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    words: list[str],
    reason: str,
) -> None:
    assert reason in refusal([*words_of(mapped, tmp_path / 'out', name), *words], capsys)
    assert not (tmp_path / 'out').exists()


def test_empty_or_damaged_maps_are_refused_in_one_line(
    mapped: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trajectory = ['--trajectory', str(mapped.folder / 'trajectory.tum')]
    whole = {name: (mapped.folder / name).read_bytes() for name in ('map.ply', 'map.dcgs')}
    write_ply(tmp_path / 'empty.ply', Splats(np.empty((len(PLANES), 0), np.float32)))
    damaged = {
        'half.ply': whole['map.ply'][: len(whole['map.ply']) // 2],
        'many.ply': whole['map.ply'].replace(b'vertex ', b'vertex 99999999999', 1),
        'half.dcgs': whole['map.dcgs'][: len(whole['map.dcgs']) // 2],
        'noise.dcgs': np.random.default_rng(0).bytes(10_000),
        'none.dcgs': b'',
    }
    for name, data in damaged.items():
        (tmp_path / name).write_bytes(data)
    for name in (*damaged, 'empty.ply'):
        camera = CAMERA if name.endswith('.ply') else ()
        words = ['render', str(tmp_path / name), *trajectory, *camera]
        line = refusal([*words, '--out', str(tmp_path / 'out')], capsys)
        assert line.startswith(f'dcgs: {tmp_path / name}: ')
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'T_world_cam': np.zeros((4, 4))}, 'T_world_cam of keyframe 1 is not a pose'),
        ({'T_world_cam': np.full((4, 4), 1e300)}, 'T_world_cam of keyframe 1 is not a pose'),
        ({'T_tracked': np.diag([1.0, 1.0, -1.0, 1.0])}, 'T_tracked of keyframe 1 is not a pose'),
        ({'T_tracked': np.diag([1.0, 1.0, 1.0, 2.0])}, 'T_tracked of keyframe 1 is not a pose'),
        ({'stamp_ns': 0}, 'stamps of the keyframes do not increase'),
    ],
)
def test_invalid_keyframes_are_refused(
    mapped: Run,
    saved: SavedMap,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    changes: dict[str, Any],
    reason: str,
) -> None:
    keyframes = list(saved.keyframes)
    keyframes[1] = replace(keyframes[1], **changes)
    shutil.copytree(mapped.folder, tmp_path / 'run')
    write_map(tmp_path / 'run' / 'map.dcgs', replace(saved, keyframes=tuple(keyframes)))
    changed = replace(mapped, folder=tmp_path / 'run')
    expected = f'dcgs: {tmp_path / "run" / "map.dcgs"}: {reason}'
    assert refusal(words_of(changed, tmp_path / 'out'), capsys) == expected
    assert refusal(['evaluate', str(tmp_path / 'run')], capsys) == expected


def test_a_trajectory_without_poses_is_refused(
    mapped: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / 'none.tum').write_text('# stamp ...\n')
    words = [*words_of(mapped, tmp_path / 'out')[:2], '--trajectory', str(tmp_path / 'none.tum')]
    assert 'none.tum: holds no pose' in refusal(words, capsys)
