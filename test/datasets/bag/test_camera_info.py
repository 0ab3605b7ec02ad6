# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""CameraInfo as cameras send it: late, noisy, changing, of any lens, of another size than depth's.

Each bag shows one plane with a smooth texture; what is read must be what the source's one camera
sees of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('rosbags')

from bags import (  # type: ignore[import-not-found]
    COLOR,
    DEPTH,
    INFO,
    INTERVAL_NS,
    START_NS,
    Entry,
    depth_entry,
    image_entry,
    info_entry,
    write_bag,
)
from lens_views import plane_m, texture  # type: ignore[import-not-found]
from realsense_bags import (  # type: ignore[import-not-found]
    DEPTH_INFO,
    DEPTH_OPTICAL,
    UNALIGNED,
    static_entry,
)

from dcgs_ros.cli.main import main
from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.lens_camera import Camera, LensCamera
from dcgs_ros.datasets.bag.source import BagSource
from dcgs_ros.datasets.images.resampling import scaled
from dcgs_ros.datasets.options import SourceOptions
from dcgs_ros.datasets.source import BadFrame, SourceError

PLAIN = PinholeCamera(160, 120, 131.0, 131.0, 79.0, 60.0)
FISHEYE = LensCamera(160, 120, 90.0, 90.0, 79.0, 60.0, (-0.006, 0.043, -0.041, 0.008), True)
RATIONAL = (0.45, -0.5, 8e-4, -2e-4, 0.3, 0.33, -0.4, 0.2)
TILTED = LensCamera(*(160, 120, 131.0, 131.0, 79.0, 60.0), (*RATIONAL, *[2e-4] * 4, 0.02, -0.01))
ZERO = SimpleNamespace(width=160, height=120, fx=0.0, fy=0.0, cx=0.0, cy=0.0, distortion=())
ALIGNED_INFO = DEPTH.rsplit('/', 1)[0] + '/camera_info'
NEAR_M, GREY = 2e-3, 4.0
T_COLORCAM_DEPTHCAM = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))

Bag = Callable[[Iterable[Entry]], Path]


@pytest.fixture
def bag(tmp_path: Path) -> Bag:
    return lambda entries: write_bag(tmp_path / 'bag', entries)


def millimetres(camera: Camera) -> NDArray[np.uint16]:
    return np.rint(1000 * plane_m(camera)).astype(np.uint16)


def shot(
    k: int, color: Camera, depth: Camera | None = None, frame: str = 'optical', topic: str = DEPTH
) -> list[Entry]:
    """Record the images of one frame; depth is colour's unless it is given."""
    stamp_ns = START_NS + k * INTERVAL_NS
    return [
        image_entry(COLOR, stamp_ns, 'rgb8', texture(color), 'optical'),
        depth_entry(stamp_ns, millimetres(depth or color), topic, frame),
    ]


def frames_of(source: BagSource) -> list[RgbdFrame]:
    frames = [item for item in source if isinstance(item, RgbdFrame)]
    assert len(frames) == len(source) > 0
    return frames


def assert_true(frame: RgbdFrame, camera: PinholeCamera, near_m: float = NEAR_M) -> None:
    """The frame shows the plane as the camera does."""
    inside = (slice(6, -6), slice(6, -6))
    off_m = np.abs(frame.depth_m - plane_m(camera))[inside][frame.depth_m[inside] > 0]
    assert (frame.depth_m[inside] > 0).mean() > 0.9 and off_m.max() < near_m
    off = np.abs(frame.color.astype(float) - texture(camera))[inside]
    assert off.mean() < GREY


def zooming(zooms: Iterable[float]) -> Iterator[Entry]:
    """Record a camera whose focal length changes with each frame."""
    for k, zoom in enumerate(zooms):
        now = replace(PLAIN, fx=zoom * PLAIN.fx, fy=zoom * PLAIN.fy)
        yield info_entry(START_NS + k * INTERVAL_NS, now)
        yield from shot(k, now)


def test_every_frame_has_the_intrinsics_of_its_stamp(bag: Bag) -> None:
    source = BagSource(bag(zooming([1.0, 1.01, 1.02, 1.03, 0.98])))
    assert source.camera == PLAIN
    for frame in frames_of(source):
        assert_true(frame, PLAIN)


def test_noise_of_the_intrinsics_leaves_the_images_as_recorded(bag: Bag) -> None:
    noise = 1.0 + 1e-9 * np.arange(3)
    entries = [info_entry(START_NS + k * INTERVAL_NS, PLAIN, zoom=z) for k, z in enumerate(noise)]
    source = BagSource(bag([*entries, *(e for k in range(3) for e in shot(k, PLAIN))]))
    for frame in frames_of(source):
        np.testing.assert_array_equal(frame.color, texture(PLAIN))


def test_intrinsics_of_zero_are_skipped_until_good_ones_come(bag: Bag) -> None:
    entries = [info_entry(START_NS + k * INTERVAL_NS, ZERO) for k in range(2)]
    entries += [info_entry(START_NS + 2 * INTERVAL_NS, PLAIN)]
    entries += [info_entry(START_NS + 3 * INTERVAL_NS, ZERO)]
    source = BagSource(bag([*entries, *(e for k in range(5) for e in shot(k, PLAIN))]))
    assert source.camera == PLAIN
    for frame in frames_of(source):
        np.testing.assert_array_equal(frame.color, texture(PLAIN))


def test_without_good_intrinsics_the_option_that_replaces_them_is_named(
    bag: Bag, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bag([info_entry(START_NS, ZERO), *shot(0, PLAIN)])
    assert main(['info', str(path)]) == 2
    error = capsys.readouterr().err
    assert f'no CameraInfo of {INFO} can be used: intrinsics' in error and '--camera' in error
    assert main(['info', str(path), '--camera', '131,131,79,60']) == 0
    assert 'fx 131 fy 131' in capsys.readouterr().out


def test_intrinsics_of_another_camera_refuse_their_frames_alone(bag: Bag) -> None:
    entries = list(zooming([1.0, 1.0, 2.0, 1.0]))
    good, also, other, last = BagSource(bag(entries))
    assert isinstance(other, BadFrame) and 'another camera: 160x120, fx 262.0' in other.reason
    assert isinstance(good, RgbdFrame) and isinstance(also, RgbdFrame)
    assert isinstance(last, RgbdFrame)


@pytest.mark.parametrize('given', ['131,131,79,60'])
def test_a_given_camera_holds_for_all_frames(bag: Bag, given: str) -> None:
    source = BagSource(bag(zooming([1.0, 1.03])), given)
    second = frames_of(source)[1]
    expected = texture(replace(PLAIN, fx=1.03 * PLAIN.fx, fy=1.03 * PLAIN.fy))
    np.testing.assert_array_equal(second.color, expected)


@pytest.mark.parametrize('lens', [FISHEYE, TILTED], ids=['equidistant', 'rational, 14'])
def test_images_of_any_lens_are_rectified(bag: Bag, lens: LensCamera) -> None:
    path = bag([info_entry(START_NS, lens), *shot(0, lens)])
    source = BagSource(path)
    assert not source.camera.distortion
    (frame,) = frames_of(source)
    assert_true(frame, source.camera)
    assert main(['info', str(path)]) == 0


def test_zeros_beyond_eight_coefficients_need_no_resampling(bag: Bag) -> None:
    lens = replace(PLAIN, distortion=RATIONAL)
    padded = SimpleNamespace(**{**vars(lens), 'distortion': (*RATIONAL, *[0.0] * 6)})
    source = BagSource(bag([info_entry(START_NS, padded), *shot(0, lens)]))
    assert source.camera == lens
    np.testing.assert_array_equal(frames_of(source)[0].color, texture(lens))


def test_rectified_images_are_not_undistorted_again(bag: Bag) -> None:
    color, info = '/camera/rgb/image_rect_color', '/camera/rgb/camera_info'
    raw = replace(PLAIN, distortion=(0.1, -0.2, 0.001, 0.002, 0.05))
    rectified = replace(PLAIN, fx=120.0, fy=121.0)
    entries = [e._replace(topic=color) if e.topic == COLOR else e for e in shot(0, rectified)]
    path = bag([info_entry(START_NS, raw, info, projection=rectified), *entries])
    source = BagSource(path)
    assert source.camera == rectified and not source.recorded.as_published
    np.testing.assert_array_equal(frames_of(source)[0].color, texture(rectified))


def test_a_lens_that_cannot_be_inverted_is_refused_with_numbers(
    bag: Bag, capsys: pytest.CaptureFixture[str]
) -> None:
    folded = SimpleNamespace(**{**vars(PLAIN), 'distortion': (-1.0, 0.0, 0.0, 0.0, 0.0)})
    assert main(['info', str(bag([info_entry(START_NS, folded), *shot(0, PLAIN)]))]) == 2
    error = capsys.readouterr().err
    assert 'cannot be inverted over the image' in error and 'px away' in error


@pytest.mark.parametrize('named', [True, False])
@pytest.mark.parametrize('size', [(64, 48), (320, 240)])
def test_depth_of_another_size_is_registered_by_it(
    bag: Bag, size: tuple[int, int], named: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    depth = scaled(PLAIN, *size)
    infos = [info_entry(START_NS, PLAIN)]
    if not named:
        infos.append(info_entry(START_NS, depth, DEPTH_INFO))
    topic = DEPTH if named else UNALIGNED
    path = bag([*infos, *shot(0, PLAIN, depth, DEPTH_OPTICAL, topic)])
    source = BagSource(path)
    assert source.camera == PLAIN
    assert_true(frames_of(source)[0], PLAIN)
    assert main(['info', str(path)]) == 0
    assert f'by its size of {size[0]}x{size[1]}' in capsys.readouterr().out


def test_a_zooming_cameras_small_depth_zooms_along(bag: Bag) -> None:
    entries = []
    for k, zoom in enumerate([1.0, 1.03]):
        now = replace(PLAIN, fx=zoom * PLAIN.fx, fy=zoom * PLAIN.fy)
        entries += [info_entry(START_NS + k * INTERVAL_NS, now)]
        entries += shot(k, now, scaled(now, 64, 48))
    for frame in frames_of(BagSource(bag(entries))):
        assert_true(frame, PLAIN)


def test_large_colour_is_shrunk_over_small_depth(bag: Bag) -> None:
    color, depth = scaled(PLAIN, 1280, 960), scaled(PLAIN, 160, 120)
    source = BagSource(bag([info_entry(START_NS, color), *shot(0, color, depth)]))
    assert (source.camera.width, source.camera.height) == (640, 480)
    assert_true(frames_of(source)[0], source.camera)


def test_a_damaged_first_depth_image_tells_no_size(bag: Bag) -> None:
    entries = [info_entry(START_NS, PLAIN), *(e for k in range(4) for e in shot(k, PLAIN))]
    entries[2] = depth_entry(START_NS, millimetres(PLAIN)[:60])
    bad, *good = BagSource(bag(entries))
    assert isinstance(bad, BadFrame) and 'depth is 160x60 pixels' in bad.reason
    assert len(good) == 3 and all(isinstance(frame, RgbdFrame) for frame in good)


def test_unregistered_depth_follows_its_own_intrinsics(bag: Bag) -> None:
    """In colour's frame, as one that is seen from there."""
    depth = PinholeCamera(140, 110, 100.0, 101.0, 70.0, 55.0)
    entries = [info_entry(START_NS, PLAIN)]
    for k, now in enumerate([depth, replace(depth, fx=103.0, fy=104.0)]):
        entries.append(info_entry(START_NS + k * INTERVAL_NS, now, DEPTH_INFO))
        entries += shot(k, PLAIN, now, 'optical', UNALIGNED)
    for frame in frames_of(BagSource(bag(entries))):
        assert_true(frame, PLAIN)


def aligned_in_depths_frame(topic: str = DEPTH, info: str = ALIGNED_INFO) -> list[Entry]:
    """Record registered depth whose frame is still the depth camera's, and where that is."""
    tree = static_entry([('optical', DEPTH_OPTICAL, T_COLORCAM_DEPTHCAM)])
    infos = [info_entry(START_NS, PLAIN), info_entry(START_NS, PLAIN, info)]
    return [tree, *infos, *shot(0, PLAIN, PLAIN, DEPTH_OPTICAL, topic)]


@pytest.mark.parametrize('topic', [DEPTH, '/sensor/depth/image'])
@pytest.mark.parametrize('with_tree', [True, False])
def test_registered_depth_in_depths_frame_is_not_registered_again(
    bag: Bag, topic: str, with_tree: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    entries = aligned_in_depths_frame(topic, topic.rsplit('/', 1)[0] + '/camera_info')
    path = bag(entries if with_tree else entries[1:])
    (frame,) = frames_of(BagSource(path))
    np.testing.assert_array_equal(frame.depth_m, millimetres(PLAIN) / np.float32(1000))
    assert main(['info', str(path)]) == 0
    said = capsys.readouterr().out
    assert f'though in frame {DEPTH_OPTICAL}' in said
    assert ('its name says' if topic == DEPTH else 'it has the intrinsics of colour') in said


def test_the_user_overrides_what_is_decided(bag: Bag) -> None:
    path = bag(aligned_in_depths_frame())
    source = BagSource(path, options=SourceOptions(depth_registration='extrinsics'))
    assert source.recorded.registration.T_colorcam_depthcam is not None
    assert np.abs(frames_of(source)[0].depth_m - plane_m(PLAIN)).max() > NEAR_M
    with pytest.raises(SourceError, match='no extrinsics'):
        BagSource(
            write_bag(path.with_name('bare'), aligned_in_depths_frame()[1:]),
            options=SourceOptions(depth_registration='extrinsics'),
        )


def test_unregistered_depth_may_be_declared_registered(
    bag: Bag, capsys: pytest.CaptureFixture[str]
) -> None:
    other = replace(PLAIN, cx=75.0)
    infos = [info_entry(START_NS, PLAIN), info_entry(START_NS, other, DEPTH_INFO)]
    path = bag([*infos, *shot(0, PLAIN, PLAIN, DEPTH_OPTICAL, UNALIGNED)])
    with pytest.raises(SourceError, match=r'no extrinsics.*depth_registration=none'):
        BagSource(path)
    for words in (
        [str(path), '--depth-registration', 'none'],
        [f'{path}?depth_registration=none'],
    ):
        assert main(['info', *words]) == 0
        assert 'as recorded, as you say' in capsys.readouterr().out
