# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The synthetic source: addresses, determinism, and images that agree with the ground truth."""

from itertools import islice

import cv2
import numba
import numpy as np
import pytest

from dcgs_ros.datasets.source import SourceError
from dcgs_ros.datasets.synthetic.raycast import cast
from dcgs_ros.datasets.synthetic.scenes.catalogue import SCENE_NAMES
from dcgs_ros.datasets.synthetic.sensors.catalogue import SENSORS
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.datasets.synthetic.textures import build_textures

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
PHOTOMETRIC_TOLERANCE = 1.5  # grey levels, median over the image
TURN_FRAME = 102  # 3.4 s: the peak of the room's first fast turn


def open_source(address):
    """Open a synthetic address."""
    return SyntheticSource.from_address(f'synthetic:{address}')


@pytest.mark.parametrize(
    ('address', 'named'),
    [
        ('synthetic:attic', 'room, plane, zigzag, desk, corridor, ring'),
        ('synthetic:', 'room, plane, zigzag'),
        ('file:room', 'synthetic:'),
        (
            'synthetic:room?colour=red',
            'sensor, speed, light, motion, period, direction, mover',
        ),
        ('synthetic:room?sensor=lidar', 'kinect, d435i, ideal, d435i_measured, kinect_measured'),
        ('synthetic:room?frames=0', '1 to 1000000'),
        ('synthetic:room?frames=1000001', '1 to 1000000'),
        ('synthetic:room?frames=2.5', 'integer'),
        ('synthetic:room?frames=', 'integer'),
        ('synthetic:room?seed=-1', 'seed'),
        ('synthetic:room?seed=one', 'integer'),
        ('synthetic:room?speed=0', '0.1 to 10'),
        ('synthetic:room?speed=11', '0.1 to 10'),
        ('synthetic:room?speed=nan', '0.1 to 10'),
        ('synthetic:room?speed=fast', 'number'),
        ('synthetic:room?seed=1&seed=2', 'twice'),
        ('synthetic:room?seed', 'key=value'),
    ],
)
def test_wrong_addresses_name_what_would_do(address, named):
    """A wrong address is refused before anything is rendered."""
    with pytest.raises(SourceError, match=named):
        SyntheticSource.from_address(address)


def test_address_sets_everything():
    """Options are parsed, the others have their defaults."""
    address = 'synthetic:zigzag?frames=7&seed=3&sensor=d435i&speed=2'
    source = SyntheticSource.from_address(address)
    assert source.name == address and len(source) == 7
    assert source.options.seed == 3 and source.options.speed == 2
    assert len(open_source('room')) == 300
    assert source.sensor.b_per_m == pytest.approx(0.08 / (385 * 0.05))


@pytest.mark.slow
@pytest.mark.parametrize('sensor', ['kinect', 'd435i'])
def test_same_address_same_bytes(sensor):
    """Twice from one source, once from another, with one thread and with two."""
    source = open_source(f'room?frames=2&seed=4&sensor={sensor}')
    runs = [list(source), list(source)]
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        runs.append(list(open_source(f'room?frames=2&seed=4&sensor={sensor}')))
    finally:
        numba.set_num_threads(before)
    for run in runs[1:]:
        for a, b in zip(runs[0], run, strict=True):
            assert (a.stamp_ns, a.depth_stamp_ns) == (b.stamp_ns, b.depth_stamp_ns)
            assert np.array_equal(a.color, b.color) and np.array_equal(a.depth_m, b.depth_m)
    other = next(iter(open_source(f'room?frames=1&seed=5&sensor={sensor}')))
    assert not np.array_equal(runs[0][0].color, other.color)


def photometric_error(source, frames, shift_px=0.0):
    """Return the median grey-level difference of points mapped between frames by the truth."""
    a, b = (source.render(k) for k in frames)
    camera, (T_world_a, T_world_b) = source.camera, source.groundtruth.T_world_cam[list(frames)]
    T_b_a = np.linalg.inv(T_world_b) @ T_world_a
    v, u = np.mgrid[2:478:3, 2:638:3]
    z = a.depth_m[v, u].astype(np.float64)
    rays = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(z)], -1
    )
    moved = (rays * z[..., None]) @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    pixels = (moved[..., :2] / moved[..., 2:] * camera.fx + [camera.cx, camera.cy]).astype('f4')
    pixels += np.float32(shift_px)
    x, y = pixels[..., 0], pixels[..., 1]
    there = cv2.remap(b.depth_m, x, y, cv2.INTER_NEAREST)
    grey = cv2.remap(b.color @ LUMA, x, y, cv2.INTER_LINEAR)
    visible = np.abs(there - moved[..., 2]) < 0.02
    assert visible.mean() > 0.4
    return np.median(np.abs(grey - a.color[v, u] @ LUMA)[visible])


@pytest.mark.parametrize('frames', [(0, 6), (99, 105)])
def test_color_depth_and_groundtruth_agree(frames):
    """Points keep their colour; half a pixel of convention error would show."""
    source = open_source('room?sensor=ideal&frames=120')
    error = photometric_error(source, frames)
    assert error < PHOTOMETRIC_TOLERANCE
    assert photometric_error(source, frames, shift_px=0.5) > 1.5 * error


@pytest.mark.parametrize('sensor', ['kinect', 'd435i'])
def test_depth_is_taken_at_its_stamp_plus_the_offset(sensor):
    """In a fast turn depth fits the pose at that instant, neither the stamp's nor colour's."""
    source = open_source(f'room?frames=120&sensor={sensor}')
    frame = source.render(TURN_FRAME)
    offset_ns = round(source.colour_depth_offset_ms * 1e6)
    assert offset_ns != 0
    errors = []
    for stamp_ns in (frame.depth_stamp_ns + offset_ns, frame.depth_stamp_ns, frame.stamp_ns):
        scene, pose = source._scenario.scene, source.pose(stamp_ns)
        true = cast(scene, build_textures(), source.camera, pose, color=False).depth_m
        valid = (frame.depth_m > 0) & (true > 0)
        errors.append(np.median(np.abs(frame.depth_m - true)[valid]))
    assert errors[0] < 0.9 * min(errors[1:])


def test_ideal_is_synchronous():
    """One instant, one exposure, no offset."""
    frame = open_source('room?sensor=ideal').render(5)
    assert frame.stamp_ns == frame.depth_stamp_ns
    assert open_source('room?sensor=ideal').colour_depth_offset_ms == 0


@pytest.mark.parametrize('sensor', ['kinect', 'd435i'])
def test_stamps_are_ordered_and_unsynchronised(sensor):
    """30 Hz of colour; depth precedes it by up to 25 ms, by another amount each time."""
    source = open_source(f'room?frames=5000&sensor={sensor}')
    stamps = source.groundtruth.stamps_ns
    assert np.abs(np.diff(stamps) - 1e9 / 30).max() < 2
    lags_ms = np.array([source.depth_lag_ns(k) for k in range(5000)]) * 1e-6
    assert lags_ms.min() >= 0 and lags_ms.max() <= 25 and lags_ms.std() > 2
    assert (np.diff(stamps - (lags_ms * 1e6).astype(np.int64)) > 0).all()


def test_double_speed_doubles_the_path():
    """The truth at speed 2 passes every other pose of speed 1."""
    slow = open_source('room?frames=201').groundtruth.T_world_cam
    fast = open_source('room?frames=101&speed=2').groundtruth.T_world_cam
    np.testing.assert_allclose(fast, slow[::2], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(5))
def test_room_has_corners_depth_and_holes(seed):
    """There is enough texture to track, and a third of stereo depth is missing."""
    source = open_source(f'room?seed={seed}&sensor=d435i&frames=1800')
    holes = []
    for index in range(40 * seed, 1800, 450):
        frame = source.render(index)
        half = cv2.resize(
            cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), (320, 240), interpolation=cv2.INTER_AREA
        )
        corners = cv2.goodFeaturesToTrack(half, 1000, 0.01, 5)
        assert len(corners) > 200
        holes.append((frame.depth_m == 0).mean())
        seen = frame.depth_m[frame.depth_m > 0]
        assert ((seen > 0.6) & (seen < 3.5)).mean() > 0.9
    assert 0.25 < np.mean(holes) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize('scene', SCENE_NAMES)
def test_every_scene_renders_with_every_sensor(scene):
    """The pattern keeps untextured surfaces from becoming one hole."""
    for sensor in SENSORS:
        source = open_source(f'{scene}?sensor={sensor}&frames=2')
        frames = list(islice(source, 2))
        assert len(frames) == 2 == len(source.groundtruth)
        assert (frames[1].depth_m > 0).mean() > (0.2 if 'measured' in sensor else 0.5)
        assert 40 < frames[1].color.mean() < 200
