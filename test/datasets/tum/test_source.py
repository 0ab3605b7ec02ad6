# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""TUM folders: what is read is what was written, and what is wrong is named."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import folders  # type: ignore[import-not-found]
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.datasets.options import SourceOptions
from dcgs_ros.datasets.source import BadFrame, Source, SourceError
from dcgs_ros.datasets.tum.index import ASSOCIATIONS
from dcgs_ros.datasets.tum.source import open_tum
from dcgs_ros.io.trajectory import TrajectoryFileError

Writer = Callable[..., Path]

SMALL = '60,61,31.5,23.5'  # intrinsics of the 64x48 images the fixture writes
FLOAT32_STEP = 1e-6  # metres, at a few metres


def good_frames(source: Source) -> list[RgbdFrame]:
    frames = list(source)
    assert all(isinstance(frame, RgbdFrame) for frame in frames), frames
    return [frame for frame in frames if isinstance(frame, RgbdFrame)]


def test_frames_are_what_was_written(tum_folder: Writer) -> None:
    source = open_tum(tum_folder(frames=4), camera=SMALL)
    frames = good_frames(source)
    assert len(source) == len(frames) == 4
    for k, frame in enumerate(frames):
        assert frame.stamp_ns == 100_000_000_000 + 30_000_000 * k
        assert frame.depth_stamp_ns == frame.stamp_ns + 5_000_000
        assert np.all(frame.color == (10 * k, 100, 200))
        np.testing.assert_allclose(frame.depth_m, 1 + 0.1 * k, atol=FLOAT32_STEP)


@pytest.mark.parametrize('size', [(32, 24), (128, 96)])
def test_depth_of_another_size_is_scaled_to_colours(
    tum_folder: Writer, size: tuple[int, int]
) -> None:
    folder = tum_folder(frames=4)
    for k in range(4):
        wrong = {1: (size[0] + 4, size[1]), 2: (size[0] // 2, size[1] // 2)}.get(k, size)
        depth = np.full(wrong[::-1], 5000, np.uint16)
        depth[:, wrong[0] // 2 :] = 10000
        cv2.imwrite(str(folder / 'depth' / f'{k}.png'), depth)
    source = open_tum(folder, camera=SMALL)
    assert source.notes == (f'depth of {size[0]}x{size[1]} pixels is scaled to those of colour',)
    first, *others, last = source
    for frame in (first, last):
        assert isinstance(frame, RgbdFrame)
        assert (frame.depth_m[:, :32] == 1.0).all() and (frame.depth_m[:, 32:] == 2.0).all()
    for bad in others:
        assert isinstance(bad, BadFrame)
        assert f"the camera's images are {size[0]}x{size[1]}" in bad.reason


def test_reading_twice_gives_the_same(tum_folder: Writer) -> None:
    source = open_tum(tum_folder(), camera=SMALL)
    for first, second in zip(good_frames(source), good_frames(source), strict=True):
        assert first.stamp_ns == second.stamp_ns
        np.testing.assert_array_equal(first.depth_m, second.depth_m)


def test_jpeg_color_is_read(tum_folder: Writer) -> None:
    folder = tum_folder(frames=3)
    for png in (folder / 'rgb').glob('*.png'):
        image = cv2.imread(str(png))
        assert image is not None
        cv2.imwrite(str(png.with_suffix('.jpg')), image)
        png.unlink()
    index = folder / 'rgb.txt'
    index.write_text(index.read_text().replace('.png', '.jpg'))
    jpeg_error = 4
    for k, frame in enumerate(good_frames(open_tum(folder, camera=SMALL))):
        assert np.abs(frame.color.astype(int) - (10 * k, 100, 200)).max() <= jpeg_error


def test_associations_are_preferred(tum_folder: Writer) -> None:
    folder = tum_folder(frames=4)
    row = '100.030000 rgb/1.png 100.040000 depth/2.png\n'
    (folder / 'associations.txt').write_text(row)
    (frame,) = good_frames(open_tum(folder, camera=SMALL))
    assert frame.depth_stamp_ns == 100_040_000_000
    np.testing.assert_allclose(frame.depth_m, 1.2, atol=FLOAT32_STEP)


@pytest.mark.parametrize('name', ASSOCIATIONS)
@pytest.mark.parametrize('encoding', ['utf-8', 'utf-8-sig'])
def test_associations_may_have_other_names_commas_and_a_byte_order_mark(
    tum_folder: Writer, name: str, encoding: str
) -> None:
    folder = tum_folder(frames=4)
    rows = 'time,colour,time,depth\n100.030000,rgb/1.png,100.040000,depth/2.png\n'
    (folder / name).write_text(rows, encoding=encoding)
    (frame,) = good_frames(open_tum(folder, camera=SMALL))
    assert (frame.stamp_ns, frame.depth_stamp_ns) == (100_030_000_000, 100_040_000_000)


def test_depth_first_in_associations_is_turned(tum_folder: Writer) -> None:
    folder = tum_folder(frames=4)
    row = '100.040000 depth/2.png 100.030000 rgb/1.png\n'
    for rows in (row, '100.0 depth/8.png 100.01 rgb/8.png\n' + row):  # the first is not there
        (folder / 'associations.txt').write_text(rows)
        source = open_tum(folder, camera=SMALL)
        *_, frame = source
        assert isinstance(frame, RgbdFrame)
        assert (frame.stamp_ns, frame.depth_stamp_ns) == (100_030_000_000, 100_040_000_000)
        assert 'lists depth before colour' in source.notes[0]


def test_a_depth_image_may_serve_two_colours(tum_folder: Writer) -> None:
    folder = tum_folder(frames=4)
    rows = ['100.00 rgb/0.png 100.01 depth/0.png', '100.03 rgb/1.png 100.01 depth/0.png']
    (folder / 'associations.txt').write_text('\n'.join(rows))
    frames = good_frames(open_tum(folder, camera=SMALL))
    assert [frame.depth_stamp_ns for frame in frames] == [100_010_000_000] * 2


def test_associations_without_any_close_pair_are_refused(tum_folder: Writer) -> None:
    folder = tum_folder(frames=4)
    row = '100.030000 rgb/1.png 100.065000 depth/2.png\n'
    (folder / 'associations.txt').write_text(row)
    with pytest.raises(SourceError, match=r'within 20 ms.*gaps 35\.0 to 35\.0 ms'):
        open_tum(folder, camera=SMALL)


def test_a_truncated_jpeg_is_no_grey_frame(tum_folder: Writer) -> None:
    folder = tum_folder(frames=1)
    path = folder / 'rgb' / '0.png'  # decoders go by content, not by name
    noise = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    data = cv2.imencode('.jpg', noise)[1].tobytes()
    path.write_bytes(data)
    good_frames(open_tum(folder, camera=SMALL))
    path.write_bytes(data[: len(data) // 2])
    (frame,) = open_tum(folder, camera='fr3')
    assert isinstance(frame, BadFrame)
    assert f'cut off after {len(data) // 2} bytes' in frame.reason


@pytest.mark.parametrize(
    ('name', 'preset'),
    [
        ('rgbd_dataset_freiburg1_xyz', 'fr1'),
        ('tum_fr2_desk', 'fr2'),
        ('FR3', 'fr3'),
        ('mini_fr1_xyz_vga_120', 'fr1'),
    ],
)
def test_camera_comes_from_the_name(tum_folder: Writer, name: str, preset: str) -> None:
    source = open_tum(tum_folder(name))
    assert source.camera == PRESETS[preset].camera
    assert bool(source.camera.distortion) == (preset != 'fr3')


@pytest.mark.parametrize('name', ['office', 'fr4_desk', 'fr10'])
def test_unknown_camera_is_asked_for(tum_folder: Writer, name: str) -> None:
    with pytest.raises(SourceError, match='--camera'):
        open_tum(tum_folder(name))


@pytest.mark.parametrize('camera', ['d435i', 'fr1', '615,615,319.5,239.5'])
def test_the_depth_unit_is_the_layouts_however_the_camera_is_named(
    tum_folder: Writer, camera: str
) -> None:
    folder = tum_folder(size=(640, 480), frames=1)
    source = open_tum(folder, camera)
    (frame,) = good_frames(source)
    np.testing.assert_allclose(frame.depth_m, 1.0, atol=FLOAT32_STEP)
    if camera in PRESETS:
        assert source.sensor == PRESETS[camera].sensor
    (frame,) = good_frames(open_tum(folder, camera, options=SourceOptions(depth_per_metre=1000)))
    np.testing.assert_allclose(frame.depth_m, 5.0, atol=FLOAT32_STEP)


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def _empty(path: Path) -> None:
    path.write_bytes(b'')


def _flip_a_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))


def _rewrite(image: NDArray[Any]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        cv2.imwrite(str(path), image)

    return damage


BAD_IMAGES: dict[str, tuple[str, Callable[[Path], None], str]] = {
    'missing': ('depth', Path.unlink, 'No such file'),
    'missing colour': ('rgb', Path.unlink, 'No such file'),
    'truncated': ('depth', _truncate, r'cut off after \d+ bytes'),
    'truncated colour': ('rgb', _truncate, r'cut off after \d+ bytes'),
    'corrupt': ('depth', _flip_a_byte, 'cannot be decoded'),
    'empty': ('depth', _empty, r'\(0 bytes\) is neither'),
    'wrong size': ('depth', _rewrite(np.ones((24, 32), np.uint16)), "32x24.*camera's.*64x48"),
    '8 bits': ('depth', _rewrite(np.ones((48, 64), np.uint8)), r'1 channel\(s\) of 8 bits'),
    '3 channels': ('depth', _rewrite(np.ones((48, 64, 3), np.uint16)), r'3 channel\(s\) of 16'),
    'all zero': ('depth', _rewrite(np.zeros((48, 64), np.uint16)), 'zero in all 3072 pixels'),
}


@pytest.mark.parametrize('fault', BAD_IMAGES)
def test_one_bad_image_is_one_bad_frame(tum_folder: Writer, fault: str) -> None:
    kind, damage, reason = BAD_IMAGES[fault]
    folder = tum_folder(frames=4)
    damage(folder / kind / '2.png')
    frames = list(open_tum(folder, camera=SMALL))
    assert [isinstance(frame, BadFrame) for frame in frames] == [False, False, True, False]
    bad = frames[2]
    assert isinstance(bad, BadFrame)
    assert bad.name == 'frame 3 of 4 (rgb/2.png)'
    assert re.search(reason, bad.reason)
    assert f'{kind}/2.png' in bad.reason


@pytest.mark.slow
@pytest.mark.parametrize('name', ['rgb.txt', 'associations.txt', 'groundtruth.txt'])
def test_no_mutant_of_its_files_does_harm(tum_folder: Writer, name: str) -> None:
    folder = tum_folder(frames=6)
    rows = [
        f'{100 + 0.03 * k:.3f} rgb/{k}.png {100 + 0.03 * k:.3f} depth/{k}.png' for k in range(6)
    ]
    if name == 'associations.txt':
        (folder / name).write_text('\n'.join(rows))
    damaged = folders.mutants((folder / name).read_bytes(), 300, seed=4)
    assert folders.survives(folder / name, damaged, lambda: open_tum(folder, SMALL)) < 300


BAD_LINES = {
    'no number': ('abc rgb/9.png', "'abc' is no time"),
    'not finite': ('nan rgb/9.png', 'no usable time'),
    'too large': ('1e30 rgb/9.png', 'no usable time'),
    'columns': ('101.0 rgb/9.png 3', '3 columns, not 2'),
    'parent': ('101.0 ../../secret.png', 'leads out of the dataset'),
    'no path': ('101.0 a\0b.png', r"'a\\x00b\.png' is not a path"),
    'absolute': ('101.0 /etc/secret.png', 'leads out of the dataset'),
}


@pytest.mark.parametrize('fault', BAD_LINES)
def test_a_bad_index_line_is_named(tum_folder: Writer, fault: str) -> None:
    line, reason = BAD_LINES[fault]
    folder = tum_folder(frames=4)
    with (folder / 'rgb.txt').open('a') as file:
        file.write(line + '\n')
    with pytest.raises(SourceError, match=rf'rgb\.txt:6: .*{reason}'):
        open_tum(folder, camera=SMALL)


@pytest.mark.parametrize('index', ['rgb.txt', 'depth.txt', 'associations.txt'])
def test_an_empty_index_is_named(tum_folder: Writer, index: str) -> None:
    folder = tum_folder()
    (folder / index).write_text('# nothing\n\n')
    with pytest.raises(SourceError, match=rf'{index}: names no image'):
        open_tum(folder, camera=SMALL)


def test_no_overlap_in_time_is_told_with_numbers(tum_folder: Writer) -> None:
    folder = tum_folder(frames=4)
    index = folder / 'depth.txt'
    index.write_text(index.read_text().replace('100.', '161.'))
    expected = r'none of 4 .*100\.09\d+ s, depth 161\.005\d+ .*gaps 60915\.0 to 61005\.0 ms'
    with pytest.raises(SourceError, match=expected):
        open_tum(folder, camera=SMALL)


def test_what_is_no_dataset_is_told_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(
        SourceError, match=r'neither associations\.txt nor rgb\.txt and depth\.txt'
    ):
        open_tum(tmp_path)
    with pytest.raises(SourceError, match='no such folder'):
        open_tum(tmp_path / 'nowhere')


def test_ground_truth_is_optional(tum_folder: Writer) -> None:
    folder = tum_folder(frames=4)
    truth = open_tum(folder).groundtruth
    assert truth is not None
    assert len(truth) == 4
    moved = folder.parent / 'elsewhere.txt'
    (folder / 'groundtruth.txt').rename(moved)
    assert open_tum(folder).groundtruth is None
    named = open_tum(folder, groundtruth=moved).groundtruth
    assert named is not None
    np.testing.assert_array_equal(named.stamps_ns, truth.stamps_ns)


def test_nan_in_ground_truth_is_left_out_and_named(tum_folder: Writer) -> None:
    folder = tum_folder()
    with (folder / 'groundtruth.txt').open('a') as file:
        file.write('101.0 0 nan 0 0 0 0 1\n')
    source = open_tum(folder)
    assert source.groundtruth is not None
    assert len(source.groundtruth) == 4
    (note,) = source.notes
    assert re.search(r'left out 1 of 5 poses.*groundtruth\.txt:5: pose is not finite', note)
    (folder / 'groundtruth.txt').write_text('101.0 0 nan 0 0 0 0 1\n')
    with pytest.raises(TrajectoryFileError, match=r'groundtruth\.txt:1: pose is not finite'):
        open_tum(folder)


def test_a_csv_is_ground_truth_too(tum_folder: Writer) -> None:
    folder = tum_folder(frames=4)
    (folder / 'groundtruth.txt').unlink()
    (folder / 'groundtruth.csv').write_text('100.0,1,2,3,0,0,0,1\n')
    truth = open_tum(folder).groundtruth
    assert truth is not None
    np.testing.assert_array_equal(truth.T_world_cam[0, :3, 3], (1, 2, 3))
