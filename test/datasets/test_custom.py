# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Custom folders are read as `dcgs.yaml` describes them, or the error says how it should."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import mkdtemp

import folders  # type: ignore[import-not-found]
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.datasets.custom import is_custom, open_custom, write_description
from dcgs_ros.datasets.options import SourceOptions
from dcgs_ros.datasets.source import SourceError
from dcgs_ros.datasets.tum.source import open_tum
from dcgs_ros.io.trajectory import format_stamp_ns

FLOAT32_STEP = 1e-6  # metres, at a few metres
TEXT = """\
camera: {width: 64, height: 48, fx: 50, fy: 51.0, cx: 31.5, cy: 23.5, distortion: []}
color: rgb/*.png
depth: depth/*.png
rate_hz: 25
depth_per_metre: 1000
sensor: {a_m: 0.002, depth_max_m: 7}
groundtruth: truth.txt
"""
TRUTH = '0 0 0 0 0 0 0 1\n0.04 1 0 0 0 0 0 1\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    names = [f'{kind}/{k}.png' for kind in ('rgb', 'depth') for k in (8, 9, 10)]
    written = folders.write_custom(tmp_path / 'own', TEXT, names[:3], names[3:])
    (written / 'truth.txt').write_text(TRUTH)
    return written


def change(folder: Path, **values: object) -> None:
    """Set keys of the description, or with None remove them."""
    tree = {**yaml.safe_load(TEXT), **values}
    tree = {key: value for key, value in tree.items() if value is not None}
    (folder / 'dcgs.yaml').write_text(yaml.safe_dump(tree))


def test_images_pair_in_natural_order_at_the_rate(folder: Path) -> None:
    assert is_custom(folder)
    source = open_custom(folder)
    assert source.name == 'own'
    assert source.camera == folders.CAMERA
    default = SensorNoise.structured_light()
    assert source.sensor == SensorNoise(0.002, default.b_per_m, default.depth_min_m, 7.0)
    for k, frame in enumerate(folders.good_frames(source)):
        assert frame.stamp_ns == frame.depth_stamp_ns == k * 40_000_000
        np.testing.assert_array_equal(frame.color, folders.color_of(k))
        np.testing.assert_allclose(frame.depth_m, k + 1, atol=FLOAT32_STEP)
    assert source.groundtruth is not None
    assert source.groundtruth.stamps_ns.tolist() == [0, 40_000_000]


def test_other_numbers_of_images_are_no_pairs(folder: Path) -> None:
    (folder / 'depth/9.png').unlink()
    with pytest.raises(SourceError, match=r'3 colour and 2 depth images.*rgb'):
        open_custom(folder)
    change(folder, depth='deep/*.png')
    with pytest.raises(SourceError, match=r'deep: cannot be read: No such file'):
        open_custom(folder)
    change(folder, depth='depth/*.jpg')
    with pytest.raises(SourceError, match=r'no image is called depth/\*\.jpg'):
        open_custom(folder)


def test_names_are_stamps_and_the_nearest_pair(tmp_path: Path) -> None:
    text = TEXT.replace('rate_hz: 25', 'stamps: names').replace('groundtruth: truth.txt', '')
    colors = ['c/1700000000.100000001.png', 'c/1700000000.2.png', 'c/1700000000.3.png']
    depths = ['d/1700000000.195.png', 'd/1700000000.109.png']
    folder = folders.write_custom(tmp_path / 'own', text, colors, depths)
    change(
        folder, color='c/*.png', depth='d/*.png', stamps='names', rate_hz=None, groundtruth=None
    )
    first, second = folders.good_frames(open_custom(folder))
    assert (first.stamp_ns, first.depth_stamp_ns) == (1700000000100000001, 1700000000109000000)
    assert (second.stamp_ns, second.depth_stamp_ns) == (1700000000200000000, 1700000000195000000)
    np.testing.assert_allclose(first.depth_m, 2.0, atol=FLOAT32_STEP)
    (folder / 'c/1700000000.20.png').touch()
    with pytest.raises(SourceError, match=r'stamp 1700000000\.200000000 a second time'):
        open_custom(folder)
    (folder / 'c/last.png').touch()
    with pytest.raises(SourceError, match=r"c/last\.png: 'last' is no time"):
        open_custom(folder)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
@given(st.lists(st.integers(0, 2**61), min_size=1, max_size=3, unique=True))
def test_stamps_in_names_are_read_to_the_nanosecond(tmp_path: Path, stamps_ns: list[int]) -> None:
    folder = Path(mkdtemp(dir=tmp_path))
    change(
        folder, color='*.color', depth='*.depth', stamps='names', rate_hz=None, groundtruth=None
    )
    for stamp_ns in stamps_ns:
        for kind in ('color', 'depth'):
            (folder / f'{format_stamp_ns(stamp_ns)}.{kind}').touch()
    pairs = open_custom(folder).pairs
    assert [pair.color.stamp_ns for pair in pairs] == sorted(stamps_ns)
    assert [pair.depth.stamp_ns for pair in pairs] == sorted(stamps_ns)


def test_a_preset_brings_camera_noise_and_unit(folder: Path) -> None:
    change(folder, camera='scannet', sensor=None, depth_per_metre=None)
    source = open_custom(folder)
    preset = PRESETS['scannet']
    assert (source.camera, source.sensor) == (preset.camera, preset.sensor)
    assert source.depth_per_metre == preset.depth_per_metre
    change(folder, camera='scannet', sensor={'a_m': 0.5}, depth_per_metre=2000)
    source = open_custom(folder)
    assert source.sensor.a_m == 0.5
    assert source.sensor.depth_max_m == preset.sensor.depth_max_m
    assert source.depth_per_metre == 2000


def test_arguments_go_before_the_file(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / 'other.txt'
    other.write_text('5 0 0 0 0 0 0 1\n')
    source = open_custom(folder, '60,61,31,23', other)
    assert source.camera == PinholeCamera(64, 48, 60.0, 61.0, 31.0, 23.0)
    assert source.sensor.a_m == 0.002
    assert source.groundtruth is not None
    assert source.groundtruth.stamps_ns.tolist() == [5_000_000_000]


def test_the_options_are_keys_too_and_those_given_go_first(folder: Path) -> None:
    change(folder, depth_per_metre=None)
    source = open_custom(folder, options=SourceOptions(depth_per_metre=500, rate_hz=10))
    assert source.depth_per_metre == 500
    assert [pair.color.stamp_ns for pair in source.pairs] == [0, 10**8, 2 * 10**8]
    change(folder, stamps='names', rate_hz=None, sync_slop_s=0.01)
    for name, stamp in (('8', '8.05'), ('9', '9.009'), ('10', '10')):
        (folder / f'depth/{name}.png').rename(folder / f'depth/{stamp}.png')
    assert len(open_custom(folder).pairs) == 2
    assert len(open_custom(folder, options=SourceOptions(sync_slop_s=0.06)).pairs) == 3


NUMBERS = st.floats(1e-6, 1e6)
FOCAL = st.floats(1e5, 1e6)  # so narrow a view can be undistorted whatever the coefficients are
CAMERAS = st.builds(
    PinholeCamera,
    st.integers(16, 4000),
    st.integers(16, 4000),
    FOCAL,
    FOCAL,
    *[st.floats(1e-6, 1e4)] * 2,
    st.sampled_from([0, 4, 5, 8]).flatmap(
        lambda n: st.lists(st.floats(-1, 1), min_size=n, max_size=n).map(tuple)
    ),
)
SENSORS = st.builds(SensorNoise, NUMBERS, st.floats(0, 1e3), st.floats(0, 1), st.floats(1.5, 1e3))


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40, deadline=None
)
@given(CAMERAS, SENSORS, st.floats(1, 1e6))
def test_a_written_description_reads_back_exactly(
    tmp_path: Path, camera: PinholeCamera, sensor: SensorNoise, unit: float
) -> None:
    for kind in ('rgb', 'depth'):
        (tmp_path / f'{kind}.txt').write_text(f'0.5 {kind}/0.png\n')
    write_description(tmp_path, camera, sensor, unit)
    source = open_custom(tmp_path)
    assert (source.camera, source.sensor, source.depth_per_metre) == (camera, sensor, unit)


def test_a_described_tum_folder_is_read_as_tums(tum_folder: Callable[..., Path]) -> None:
    folder = tum_folder(frames=3)
    numbers = PinholeCamera(64, 48, *map(np.float64, (60, 61, 31.5, 23.5)))  # type: ignore[arg-type]
    write_description(folder, numbers, PRESETS['fr3'].sensor, 5000)
    ours, tums = open_custom(folder), open_tum(folder, '60,61,31.5,23.5')
    assert ours.pairs == tums.pairs
    assert (ours.camera, ours.sensor) == (tums.camera, tums.sensor)
    assert ours.depth_per_metre == tums.depth_per_metre
    assert ours.groundtruth is not None
    assert tums.groundtruth is not None
    np.testing.assert_array_equal(ours.groundtruth.T_world_cam, tums.groundtruth.T_world_cam)
    (folder / 'groundtruth.txt').unlink()
    write_description(folder, numbers, PRESETS['fr3'].sensor, 5000)
    assert open_custom(folder).groundtruth is None
    (folder / 'rgb.txt').write_text('1.0\n')
    with pytest.raises(SourceError, match=r'rgb\.txt:1: 1 columns'):
        open_custom(folder)


def test_a_description_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r'dcgs\.yaml: cannot be written: No such file'):
        write_description(tmp_path / 'nowhere', folders.CAMERA, SensorNoise(), 1000)


CAMERA = yaml.safe_load(TEXT)['camera']
BAD_VALUES: dict[str, tuple[dict[str, object], str]] = {
    'unknown key': ({'colour': 'x'}, "'colour'; there are camera, color, depth, rate_hz"),
    'key that is no text': ({1: 2}, 'a key a int; there are'),  # type: ignore[dict-item]
    'unknown of the camera': ({'camera': {**CAMERA, 'f': 1}}, "camera has a key 'f'; .*width"),
    'unknown of the sensor': ({'sensor': {'a': 1}}, "sensor has a key 'a'; there are a_m, b_per"),
    'no camera': ({'camera': None}, 'camera is a NoneType, neither'),
    'no preset': ({'camera': 'leica'}, "camera is 'leica', neither .* nor one of fr1"),
    'list for a camera': ({'camera': [1, 2]}, 'camera is a list'),
    'list for a sensor': ({'sensor': [1, 2]}, 'sensor has a list, not a map of a_m'),
    'text for distortion': ({'camera': {**CAMERA, 'distortion': 'no'}}, 'camera.distortion is'),
    'map in distortion': ({'camera': {**CAMERA, 'distortion': [{}] * 4}}, r'distortion\[0\] is a'),
    'odd distortion': ({'camera': {**CAMERA, 'distortion': [1]}}, 'distortion has 1 numbers'),
    'huge image': (
        {'camera': {**CAMERA, 'width': 1e9}},
        r'camera: width, height: .* is not an image',
    ),
    'endless focal': ({'camera': {**CAMERA, 'fx': float('inf')}}, 'camera: .*not usable'),
    'number beyond floats': ({'camera': {**CAMERA, 'fx': 10**400}}, 'camera: fx is a int'),
    'negative noise': ({'sensor': {'a_m': -1}}, 'need a_m > 0'),
    'number that is none': ({'sensor': {'a_m': None}}, 'a_m is a NoneType, not a number'),
    'no unit': ({'depth_per_metre': None}, 'depth_per_metre is missing'),
    'unit of nothing': ({'depth_per_metre': 0}, 'depth_per_metre is 0'),
    'no rate': ({'rate_hz': None}, 'nothing for the stamps; exactly one is needed'),
    'two rates': ({'stamps': 'names'}, 'rate_hz and stamps for the stamps'),
    'rate of nothing': ({'rate_hz': 0}, 'rate_hz is 0'),
    'unknown rate': ({'rate_hz': float('nan')}, 'rate_hz is nan'),
    'unknown stamps': ({'stamps': 'mtime', 'rate_hz': None}, "stamps is 'mtime'; it can be"),
    'no colour': ({'color': None}, 'color is a NoneType, not a path'),
    'absolute': ({'color': '/etc/*.png'}, 'color: /etc/.* leads out'),
    'parent': ({'depth': 'a/../../*.png'}, r'depth: .* leads out'),
    'truth elsewhere': ({'groundtruth': '../truth.txt'}, 'groundtruth: .* leads out'),
    'nul': ({'groundtruth': 'a\0b'}, r"groundtruth: 'a\\x00b' is not a path"),
    'half a character': ({'color': '\ud800*'}, r"color: '\\ud800\*' is not a path"),
}


@pytest.mark.parametrize('fault', BAD_VALUES)
def test_a_wrong_value_is_named_with_its_key(folder: Path, fault: str) -> None:
    values, reason = BAD_VALUES[fault]
    tree = {**yaml.safe_load(TEXT), **values}
    dumped = {key: value for key, value in tree.items() if value is not None}
    (folder / 'dcgs.yaml').write_text(yaml.safe_dump(dumped))
    with pytest.raises(SourceError, match=rf'dcgs\.yaml: .*{reason}'):
        open_custom(folder)


BAD_TEXTS = {
    'empty': ('', 'the file holds a NoneType, not a map'),
    'list': ('- 1\n- 2\n', 'the file holds a list'),
    'cut off': (TEXT[:40], 'no YAML: .* in line 1'),
    'deep': ('[' * 3000, 'no YAML: more than 100 brackets'),
    'no time of day': ('camera: ' + '1:' * 200 + '1.0', 'no YAML: int too large'),
    'odd tag': ('camera: !!int ""', 'no YAML: '),
    'code': ('!!python/object/apply:os.system ["true"]', 'no YAML: could not determine a constr'),
    'binary': ('\x01\x02', 'no YAML: '),
}


@pytest.mark.parametrize('fault', BAD_TEXTS)
def test_what_is_no_description_is_named(folder: Path, fault: str) -> None:
    text, reason = BAD_TEXTS[fault]
    (folder / 'dcgs.yaml').write_text(text)
    with pytest.raises(SourceError, match=rf'dcgs\.yaml: {reason}'):
        open_custom(folder)


def test_an_alias_to_itself_or_to_very_much_is_no_camera(folder: Path) -> None:
    path = folder / 'dcgs.yaml'
    path.write_text('camera: &a [*a]\n')
    with pytest.raises(SourceError, match='more than 10000 values; does an alias'):
        open_custom(folder)
    levels = [f'  - &l{k} [{", ".join([f"*l{k - 1}"] * 9)}]' for k in range(1, 40)]
    path.write_text('\n'.join(['camera:', '  - &l0 [x]', *levels]))
    with pytest.raises(SourceError, match='more than 10000 values; does an alias'):
        open_custom(folder)


def test_a_file_too_large_to_be_one_is_not_read(folder: Path) -> None:
    with (folder / 'dcgs.yaml').open('wb') as file:
        file.truncate(2**40)
    with pytest.raises(SourceError, match='1099511627776 bytes'):
        open_custom(folder)


def test_a_folder_without_one_is_none(tmp_path: Path) -> None:
    assert not is_custom(tmp_path)
    with pytest.raises(SourceError, match=r'dcgs\.yaml: cannot be read: No such file'):
        open_custom(tmp_path)


@pytest.mark.slow
def test_no_mutant_of_its_file_does_harm(folder: Path) -> None:
    path = folder / 'dcgs.yaml'
    damaged = folders.mutants(path.read_bytes(), 500, seed=2)
    assert folders.survives(path, damaged, lambda: open_custom(folder)) < 500
