# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What the sensors that misbehave deliver: repeats, holes, rolling rows, blur, dim light."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from dcgs_ros.datasets.synthetic.raycast import cast
from dcgs_ros.datasets.synthetic.sensors.exposure import MeteredExposure
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.datasets.synthetic.textures import build_textures

MEASURED = ('d435i_measured', 'kinect_measured')
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
TURN_FRAME = 102  # 3.4 s: the peak of the room's first fast turn


def open_source(address):
    """Open a synthetic address."""
    return SyntheticSource.from_address(f'synthetic:{address}')


@pytest.mark.parametrize('sensor', MEASURED)
def test_some_images_come_again(sensor, monkeypatch):
    """3 % of colour and 2 % of depth, bit for bit, with new stamps; nothing else repeats."""
    source = open_source(f'plane?sensor={sensor}&frames=4000')

    def numbered(index, *_):
        return np.full((480, 640, 3), (index % 251, index // 251, 0), np.uint8)

    monkeypatch.setattr(source, '_color', numbered)
    monkeypatch.setattr(source, '_depth', lambda index: np.full((480, 640), index + 1, 'f4'))
    frames = [
        (frame.stamp_ns, frame.depth_stamp_ns, tuple(frame.color[0, 0]), frame.depth_m[0, 0])
        for frame in source
    ]
    stamps, depth_stamps, colors, depths = zip(*frames, strict=True)
    assert (np.diff(stamps) > 0).all() and (np.diff(depth_stamps) > 0).all()
    again = np.array([a == b for a, b in pairwise(colors)])
    depth_again = np.diff(depths) == 0
    assert again.mean() == pytest.approx(0.03, abs=0.01)
    assert depth_again.mean() == pytest.approx(0.02, abs=0.008)
    assert len(set(colors)) == 4000 - again.sum()


def test_repeated_images_are_identical():
    """As they come out of the source, in new arrays."""
    source = open_source('plane?sensor=d435i_measured&frames=12')
    source._repeats[...] = False
    source._repeats[1, 0] = source._repeats[2, 1] = True
    a, b, c = (frame for frame, _ in zip(source, range(3), strict=False))
    assert np.array_equal(a.color, b.color) and not np.array_equal(b.color, c.color)
    assert np.array_equal(b.depth_m, c.depth_m) and not np.array_equal(a.depth_m, b.depth_m)
    assert a.color is not b.color and a.stamp_ns < b.stamp_ns


@pytest.mark.slow
@pytest.mark.parametrize('sensor', MEASURED)
def test_same_address_same_bytes(sensor):
    """Twice from one source, once from another."""
    address = f'room?sensor={sensor}&frames=2&seed=2'
    source = open_source(address)
    runs = [list(source), list(source), list(open_source(address))]
    for run in runs[1:]:
        for a, b in zip(runs[0], run, strict=True):
            assert np.array_equal(a.color, b.color) and np.array_equal(a.depth_m, b.depth_m)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('sensor', 'low', 'high'), [('d435i_measured', 0.3, 0.5), ('kinect_measured', 0.2, 0.4)]
)
def test_depth_has_holes(sensor, low, high):
    """A third to a half of stereo depth is missing, about 30 % of structured light's."""
    source = open_source(f'room?sensor={sensor}')
    holes = np.mean([(source.render(k).depth_m == 0).mean() for k in range(0, 300, 30)])
    assert low < holes < high
    if sensor == 'd435i_measured':
        dim = open_source(f'room?sensor={sensor}&light=0.05')
        assert np.mean([(dim._depth(k) == 0).mean() for k in range(0, 300, 60)]) > holes + 0.05


def test_each_row_is_seen_from_its_own_pose():
    """Row y of a rolling image is row y of the image from where the camera then was."""
    source = open_source('room?sensor=d435i_measured')
    scene, camera = source._scenario.scene, source.camera
    stamp_ns = source.groundtruth.stamps_ns[TURN_FRAME]
    shares = (np.arange(480) + 0.5) / 480 - 0.5
    times_ns = stamp_ns + np.round(shares * 30e6).astype(np.int64)
    rows = np.stack([source.pose(int(t)) for t in times_ns])
    pose, textures = source.pose(int(stamp_ns)), build_textures()
    rolling = cast(scene, textures, camera, pose, color=True, T_world_rows=rows)
    still = cast(scene, textures, camera, pose, color=True)
    for y in (0, 100, 239, 380, 479):
        alone = cast(scene, textures, camera, rows[y], color=True)
        assert np.median(np.abs(alone.depth_m - rolling.depth_m)[y]) < 1e-4
        assert np.abs(alone.radiance - rolling.radiance)[y].mean() < 0.3
    assert np.abs(still.radiance - rolling.radiance)[[0, 479]].mean() > 3
    # ... and the source renders this one.
    view = source._see(TURN_FRAME)
    assert np.abs(view.depth_m - rolling.depth_m).mean() < 1e-3


@pytest.mark.parametrize('sensor', MEASURED)
def test_turning_shifts_rows_by_rate_times_readout_times_focal(sensor):
    """The top of the image is late by half a readout, the bottom early, the middle neither."""
    source = open_source(f'room?sensor={sensor}')
    readout_s = {'d435i_measured': 0.030, 'kinect_measured': 0.026}[sensor]
    stamp_ns = int(source.groundtruth.stamps_ns[TURN_FRAME])
    rolling = source._see(TURN_FRAME).radiance @ LUMA
    view = source._cast(source.camera, stamp_ns, color=True)
    still = view.radiance @ LUMA
    shifts = []
    for top in (16, 224, 432):
        row = top + 16
        late_ns = round((row / 480 - 0.5) * readout_s * 1e9)
        T_then_now = np.linalg.inv(source.pose(stamp_ns + late_ns)) @ source.pose(stamp_ns)
        ray = np.array([0.0, (row - source.camera.cy) / source.camera.fy, 1.0])
        point = T_then_now @ np.append(2.0 * ray, 1.0)
        shifts.append(source.camera.fx * point[0] / point[2])
        a, b = (image[top : top + 32].astype(np.float32) for image in (still, rolling))
        window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F)
        (dx, _), _ = cv2.phaseCorrelate(a, b, window)
        assert dx == pytest.approx(shifts[-1], abs=1.0)
    assert abs(shifts[2] - shifts[0]) > 15 and abs(shifts[1]) < 1


@pytest.mark.parametrize('light', [1.0, 0.1])
def test_blur_is_the_mean_over_the_exposure(light):
    """An image is the average of the sharp ones at the instants of its exposure, plus noise."""
    source = open_source(f'room?sensor=d435i_measured&light={light}')
    exposure = MeteredExposure(source._see(TURN_FRAME).radiance)
    assert exposure.time_s == pytest.approx(0.033 if light < 1 else 0.011, abs=0.003)
    middle_ns = int(source.groundtruth.stamps_ns[TURN_FRAME])
    scale = light * exposure.light * exposure.gain

    def sharp(time_ns):
        shares = (np.arange(480) + 0.5) / 480 - 0.5
        times_s = (time_ns - 1_000_000_000_000) * 1e-9 + shares * 0.030
        rows = source._path.poses(times_s)
        view = source._cast(source.camera, time_ns, color=True, T_world_rows=rows)
        return cv2.GaussianBlur(view.radiance @ LUMA, (3, 3), 0.5) * scale

    shares = (np.arange(25) + 0.5) / 25 - 0.5
    instants = [middle_ns + round(share * exposure.time_s * 1e9) for share in shares]
    mean = np.mean([sharp(t) for t in instants], axis=0)
    image = source.render(TURN_FRAME).color @ LUMA
    unblurred = sharp(middle_ns)
    error, otherwise = (
        np.abs(cv2.GaussianBlur(image - other, (5, 5), 1.0)) for other in (mean, unblurred)
    )
    assert np.median(error) < 1.5
    assert error.mean() < 0.5 * otherwise.mean()


def test_light_changes_the_image_only_by_blur_and_noise():
    """Exposure keeps the mean; a tenth of the light has several times the noise."""
    noise = []
    for light in (1.0, 0.1, 0.02):
        image = open_source(f'room?sensor=d435i_measured&light={light}').render(0).color
        grey = image.astype(np.float32) @ LUMA
        square = cv2.blur((grey - cv2.GaussianBlur(grey, (0, 0), 2)) ** 2, (9, 9))
        noise.append(np.sqrt(np.percentile(square, 15)))  # of plain walls
        if light >= 0.1:
            assert grey.mean() == pytest.approx(112, abs=4)
    assert noise[1] > 1.7 * noise[0] and noise[2] > 1.7 * noise[1]
    assert grey.mean() < 70


def test_lasting_noise_is_told_how_far_the_image_has_moved(monkeypatch):
    """In a fast turn by many pixels a frame, in a slow sway by few; 1.5 m away as by an angle."""
    shots = {}
    for speed in (1, 0.1):
        source = open_source(f'room?sensor=d435i_measured&speed={speed}')
        monkeypatch.setattr(source._depth_camera, 'measure', lambda *given: given[-1].travel_px)
        shots[speed] = [source._depth(k) for k in (0, TURN_FRAME, TURN_FRAME + 1, 299)]
    assert shots[1][0] == shots[0.1][0] == 0
    ahead = open_source('room').groundtruth.T_world_cam[[TURN_FRAME, TURN_FRAME + 1], :3]
    turned = np.arccos(ahead[0, :, 2] @ ahead[1, :, 2])
    moved = np.linalg.norm(ahead[1, :, 3] - ahead[0, :, 3]) / 1.5
    assert shots[1][2] - shots[1][1] == pytest.approx(615 * (turned + moved), rel=0.01)
    assert shots[0.1][3] < 0.3 * shots[1][3]
