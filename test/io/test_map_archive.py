# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Saved maps read back exactly, and inconsistent ones are refused."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from sealing import unsealed_zip  # type: ignore[import-not-found]

from dcgs_ros.core.backend.features import Features
from dcgs_ros.core.camera import LARGEST, PinholeCamera
from dcgs_ros.core.config.schema import flatten, override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.mapping.splats import Splats
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.io.archive import Archive, read_archive, write_archive
from dcgs_ros.io.map_archive import MapFileError, SavedKeyframe, SavedMap, read_map, write_map
from dcgs_ros.io.saved_tracker import SavedTracker
from dcgs_ros.io.sessions import SavedSession
from dcgs_ros.io.tracker_map import read_tracker_map

MEMORY_SLACK = 1 << 20  # bytes beside what the file's size explains
FLOAT32 = st.floats(width=32, allow_nan=False, allow_infinity=False)  # denormals and -0 too
FLOAT64 = st.floats(allow_nan=False, allow_infinity=False)
SETTINGS = st.fixed_dictionaries(
    {},
    optional={
        'ablation': st.sampled_from(['sigma_t', 'shared']),
        'threads': st.none() | st.integers(1, 64),
        'sensor.a_m': st.floats(1e-9, 1.0),
        'landmarks.corners': st.integers(1, 5000),
        'timing.colour_depth_offset_ms': st.none() | st.floats(-100, 100),
    },
)


@st.composite
def cameras(draw: st.DrawFn) -> PinholeCamera:
    count = draw(st.sampled_from([0, 4, 5, 8]))
    # A narrow view can be undistorted whatever the coefficients are.
    focal = st.floats(2e5 if count else 1e-2, LARGEST)
    center = st.floats(-1e4, 1e4) if count else st.floats(-LARGEST, LARGEST)
    return PinholeCamera(
        draw(st.integers(16, 10_000)), draw(st.integers(16, 10_000)), draw(focal), draw(focal),
        draw(center), draw(center), tuple(draw(st.floats(-1.0, 1.0)) for _ in range(count)),
    )  # fmt: skip


def numbers(draw: st.DrawFn, dtype: type, shape: Any) -> NDArray[Any]:
    kinds: dict[type, st.SearchStrategy[Any]] = {np.float32: FLOAT32, np.float64: FLOAT64}
    return draw(arrays(dtype, shape, elements=kinds[dtype]))


@st.composite
def trackers(draw: st.DrawFn) -> SavedTracker:
    n, k = draw(st.integers(0, 3)), draw(st.integers(1, 3))
    e = draw(st.integers(0, 2))
    of_keyframe = st.integers(0, k - 1)
    return SavedTracker(
        ids=draw(arrays(np.int64, n, elements=st.integers(0, 99), unique=True)),
        means=numbers(draw, np.float32, (n, 3)),
        normals=numbers(draw, np.float32, (n, 3)),
        flatness=numbers(draw, np.float32, n),
        viewpoints=numbers(draw, np.float32, (n, 3)),
        hosts=draw(arrays(np.int32, n, elements=of_keyframe)),
        observers=draw(arrays(np.int32, n, elements=of_keyframe)),
        next_id=draw(st.integers(100, 1 << 28)),
        stamps_ns=draw(arrays(np.int64, k)),
        poses=numbers(draw, np.float64, (k, 4, 4)),
        submaps=draw(arrays(np.int32, k)),
        covariances=numbers(draw, np.float64, (k, 6, 6)),
        edges=draw(arrays(np.int32, (e, 2), elements=of_keyframe)),
        edge_poses=numbers(draw, np.float64, (e, 4, 4)),
        edge_information=numbers(draw, np.float64, (e, 6, 6)),
        usual=numbers(draw, np.float64, 4),
        depth_bias=numbers(draw, np.float64, 5),
    )


@st.composite
def sessions(draw: st.DrawFn, keyframes: int, views: int) -> tuple[SavedSession, ...]:
    first = draw(st.integers(0, keyframes)), draw(st.integers(0, views))
    counts = [first, (keyframes - first[0], views - first[1])]
    name, camera = draw(st.text(max_size=9)), draw(cameras())
    sensor = SensorNoise(a_m=draw(st.floats(1e-9, 1.0)))
    return tuple(SavedSession(name, camera, sensor, *pair) for pair in counts)


@st.composite
def keyframes(draw: st.DrawFn, with_features: bool) -> SavedKeyframe:
    return SavedKeyframe(
        draw(st.integers(-(2**63), 2**63 - 1)),
        draw(arrays(np.float64, (4, 4), elements=FLOAT64)),
        draw(arrays(np.float64, (4, 4), elements=FLOAT64)),
        draw(arrays(np.float32, (2, 3), elements=FLOAT32)),
        draw(st.binary(max_size=20)),
        draw(st.binary(max_size=20)),
        draw(st.integers(-1, 0)),
        draw(st.integers(0, 2**31 - 1)),
        draw(features() if with_features else st.none()),
    )


@st.composite
def features(draw: st.DrawFn) -> Features:
    count = draw(st.integers(1, 3))
    return Features(
        draw(arrays(np.uint8, (count, 32))), numbers(draw, np.float32, (count, 2)),
        numbers(draw, np.float32, count),
    )  # fmt: skip


@st.composite
def maps(draw: st.DrawFn) -> SavedMap:
    frames = draw(st.lists(keyframes(draw(st.booleans())), max_size=3))
    n = draw(st.integers(0, 4)) if frames else 0
    landmarks = draw(st.integers(0, 3))
    ids = draw(arrays(np.int64, n, unique=True))
    viewpoints = draw(arrays(np.float32, (n, 3), elements=FLOAT32))
    covariances = draw(arrays(np.float32, (n, 6), elements=FLOAT32))
    viewpoints[ids < 0] = covariances[ids < 0] = np.nan
    hosts = st.integers(0, max(0, len(frames) - 1))
    tracker = draw(trackers())
    return SavedMap(
        camera=draw(cameras()),
        config=override(Config(), draw(SETTINGS)),
        splats=Splats(draw(arrays(np.float32, (14, n), elements=FLOAT32))),
        ids=ids,
        hosts=draw(arrays(np.int32, n, elements=hosts)),
        tracked_means=numbers(draw, np.float32, (n, 3)),
        reach_m=np.abs(numbers(draw, np.float32, n)),
        weights=numbers(draw, np.float32, n),
        viewpoints=viewpoints,
        track_covariances=covariances,
        landmarks=draw(arrays(np.float64, (landmarks, 3), elements=FLOAT64)),
        landmark_covariances=draw(arrays(np.float64, (landmarks, 3, 3), elements=FLOAT64)),
        keyframes=tuple(frames),
        tracker=tracker,
        sessions=draw(sessions(len(tracker.poses), len(frames))),
    )


def example(count: int = 5, frames: int = 2) -> SavedMap:
    """Make a map whose last Gaussian the mapper spawned."""
    rng = np.random.default_rng(0)
    ids = np.arange(10, 10 + count)
    ids[-1:] = -3
    unknown = (ids < 0)[:, None]
    return SavedMap(
        camera=PinholeCamera(64, 48, 50.1, 50.2, 31.5, 23.5, (0.1, -0.2, 1e-3, 0.0)),
        config=override(Config(), {'cloud.stride_px': 7, 'sensor.a_m': 0.1 + 0.2}),
        splats=Splats(rng.normal(size=(14, count)).astype(np.float32)),
        ids=ids,
        hosts=rng.integers(frames, size=count).astype(np.int32),
        tracked_means=np.random.default_rng(2).normal(size=(count, 3)).astype(np.float32),
        reach_m=np.where(unknown[:, 0], np.inf, 0.01).astype(np.float32),
        weights=np.ones(count, np.float32),
        viewpoints=np.where(unknown, np.nan, rng.normal(size=(count, 3))).astype(np.float32),
        track_covariances=np.where(unknown, np.nan, np.ones((count, 6))).astype(np.float32),
        landmarks=rng.normal(size=(3, 3)),
        landmark_covariances=np.tile(np.eye(3), (3, 1, 1)),
        keyframes=tuple(keyframe(stamp_ns=k) for k in range(frames)),
        tracker=tracked(count, max(frames, 1)),
        sessions=(session(max(frames, 1), frames),),
    )


def tracked(count: int, frames: int) -> SavedTracker:
    """Make a tracker's part with two edges to its first keyframe."""
    rng = np.random.default_rng(1)
    triples = rng.normal(size=(3, count, 3)).astype(np.float32)
    hosts = rng.integers(frames, size=(2, count)).astype(np.int32)
    return SavedTracker(
        ids=np.arange(10, 10 + count), means=triples[0], normals=triples[1],
        flatness=np.zeros(count, np.float32), viewpoints=triples[2], hosts=hosts[0],
        observers=hosts[1], next_id=count + 20, stamps_ns=np.arange(frames),
        poses=np.tile(np.eye(4), (frames, 1, 1)), submaps=np.zeros(frames, np.int32),
        covariances=np.tile(np.eye(6), (frames, 1, 1)),
        edges=np.array([[frames - 1, 0]] * 2, np.int32), edge_poses=rng.normal(size=(2, 4, 4)),
        edge_information=rng.normal(size=(2, 6, 6)), usual=np.array([0.8, 1.0, 0.9, 7.0]),
        depth_bias=np.zeros(5),
    )  # fmt: skip


def session(keyframes: int, views: int) -> SavedSession:
    camera = PinholeCamera(64, 48, 50.1, 50.2, 31.5, 23.5)
    return SavedSession('desk', camera, SensorNoise(), keyframes, views)


def keyframe(**changes: Any) -> SavedKeyframe:
    good = SavedKeyframe(7, np.eye(4), np.eye(4), np.ones((2, 3), np.float32), b'jpeg', b'png')
    return dataclasses.replace(good, **changes)


def assert_same(found: Any, expected: Any) -> None:
    """Compare dataclasses, their arrays bit for bit."""
    assert type(found) is type(expected)
    for field in dataclasses.fields(expected):
        one, other = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(other, np.ndarray):
            assert (one.dtype, one.shape) == (other.dtype, other.shape), field.name
            assert one.tobytes() == other.tobytes(), field.name
        elif isinstance(other, Splats | SavedTracker | Features):
            assert_same(one, other)
        elif field.name == 'keyframes':
            assert len(one) == len(other)
            for k in range(len(other)):
                assert_same(one[k], other[k])
        else:
            assert one == other, field.name


@settings(max_examples=60, deadline=None)
@given(maps())
def test_written_then_read_is_the_same_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, saved: SavedMap
) -> None:
    path = tmp_path_factory.mktemp('round') / 'a.map'
    write_map(path, saved)
    again = read_map(path)
    assert_same(again, saved)
    data = path.read_bytes()
    write_map(path, again)
    assert path.read_bytes() == data


@pytest.mark.parametrize(('count', 'frames'), [(0, 0), (0, 2), (1, 1), (2000, 30)])
def test_maps_of_any_size_come_back(tmp_path: Path, count: int, frames: int) -> None:
    saved = example(count, frames)
    write_map(tmp_path / 'a', saved)
    assert_same(read_map(tmp_path / 'a'), saved)


def known(count: int) -> Features:
    rng = np.random.default_rng(count)
    rays = rng.normal(size=(count, 2)).astype(np.float32)
    return Features(rng.integers(256, size=(count, 32), dtype=np.uint8), rays, rays[:, 0] ** 2)


@pytest.mark.parametrize(
    ('name', 'array', 'said'),
    [
        ('feature_counts', np.array([2, 4], np.int32), 'feature_descriptors is uint8 of shape'),
        ('feature_counts', np.array([-1, 6], np.int32), 'feature_counts: one is -1'),
        ('feature_counts', np.array([5], np.int32), 'feature_counts is int32 of shape'),
        ('feature_descriptors', None, "holds no 'feature_descriptors'"),
        ('feature_rays', np.full((5, 2), np.nan, np.float32), 'feature_rays: 5 of 5'),
        ('feature_rays', np.zeros((5, 3), np.float32), 'feature_rays is float32 of shape'),
        ('feature_depths_m', np.zeros(5), 'feature_depths_m is float64'),
    ],
)
def test_features_that_do_not_fit_are_refused(
    tmp_path: Path, name: str, array: NDArray[Any] | None, said: str
) -> None:
    views = (keyframe(features=known(2)), keyframe(stamp_ns=8, features=known(3)))
    write_map(tmp_path / 'a', dataclasses.replace(example(), keyframes=views))
    archive = read_archive(tmp_path / 'a')
    changed = {key: value for key, value in archive.arrays.items() if key != name}
    changed |= {} if array is None else {name: array}
    write_archive(tmp_path / 'b', changed, archive.metadata, archive.blobs)
    for read in (read_map, read_tracker_map):
        with pytest.raises(MapFileError, match=re.escape(said)):
            read(tmp_path / 'b')


def test_a_file_without_features_is_read(tmp_path: Path) -> None:
    """As they were until features were kept."""
    write_map(tmp_path / 'a', example())
    assert not any(name.startswith('feature') for name in read_archive(tmp_path / 'a').arrays)
    assert [view.features for view in read_map(tmp_path / 'a').keyframes] == [None, None]


def test_images_and_arrays_can_be_opened_without_this_package(tmp_path: Path) -> None:
    color = np.random.default_rng(1).integers(256, size=(48, 64, 3), dtype=np.uint8)
    depth = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    jpeg, png = cv2.imencode('.jpg', color)[1], cv2.imencode('.png', depth)[1]
    frame = keyframe(color_jpeg=jpeg.tobytes(), depth_png=png.tobytes())
    saved = dataclasses.replace(example(frames=1), keyframes=(frame,))
    write_map(tmp_path / 'a', saved)
    with np.load(tmp_path / 'a') as opened:
        np.testing.assert_array_equal(opened['splats'], saved.splats.planes)
        np.testing.assert_array_equal(opened['poses'], [np.eye(4)])
        read = np.frombuffer(opened['depth_000000.png'], np.uint8)
        np.testing.assert_array_equal(cv2.imdecode(read, cv2.IMREAD_UNCHANGED), depth)
        assert opened['color_000000.jpg'] == jpeg.tobytes()


def test_what_is_read_can_be_changed_and_written_again(tmp_path: Path) -> None:
    write_map(tmp_path / 'a', example())
    again = read_map(tmp_path / 'a')
    again.splats.planes[0] += 1
    again.hosts[:] = 0
    write_map(tmp_path / 'a', again)
    assert_same(read_map(tmp_path / 'a'), again)


TRACKER_FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    'few': ({'ids': np.arange(4)}, r'tracker_means is .*\(5, 3\), not .*\(4, 3\)'),
    'lost': ({'poses': np.full((2, 4, 4), np.nan)}, 'tracker_poses: 2 of 2 are not finite'),
    'host': ({'hosts': np.full(5, 2, np.int32)}, 'tracker_hosts of 5 of 5 .* none of the 2 key'),
    'observer': ({'observers': np.full(5, -1, np.int32)}, 'tracker_observers of 5 of 5'),
    'edge': ({'edges': np.full((2, 2), 7, np.int32)}, 'tracker_edges of 4 of 4 .* first 7'),
    'twice': ({'ids': np.full(5, 10)}, '5 Gaussians have only 1 different ids'),
    'id given out': ({'next_id': 14}, 'ids of the tracker are 10 to 14, the next is 14'),
    'ids without end': ({'next_id': 1 << 60}, 'the next is 1152921504606846976'),
    'own': ({'ids': np.arange(-1, 4)}, 'ids of the tracker are -1 to 3'),
}


@pytest.mark.parametrize('fault', TRACKER_FAULTS)
def test_a_tracker_that_contradicts_itself_cannot_be_made(fault: str) -> None:
    changes, reason = TRACKER_FAULTS[fault]
    with pytest.raises(MapFileError, match=reason):
        dataclasses.replace(example().tracker, **changes)


def test_keyframes_and_sessions_fit_the_tracker(tmp_path: Path) -> None:
    good = example()
    with pytest.raises(MapFileError, match='keyframe 2 is none of the 2 of the tracker'):
        dataclasses.replace(good, keyframes=(keyframe(keyframe=2),) * 2)
    for counts, what in (((3, 2), '3 keyframes, the map 2'), ((2, 1), '1 views, the map 2')):
        with pytest.raises(MapFileError, match=f'sessions have {what}'):
            dataclasses.replace(good, sessions=(session(*counts),))


def test_what_is_written_of_sessions_is_checked_when_read(tmp_path: Path) -> None:
    parts = parts_of(tmp_path / 'a')
    good = json.loads(parts.blobs['sessions.json'])
    bad: dict[str, Any] = {
        'JSONDecodeError': b'[', 'TypeError': 7, 'KeyError': [{}],
        'unknown setting': [good[0] | {'sensor': {'warp': 1}}],
        'camera is not usable': [good[0] | {'camera': {}}],
        "session 'desk' has x keyframes": [good[0] | {'keyframes': 'x'}],
        'has -1 keyframes': [good[0] | {'keyframes': -1}],
    }  # fmt: skip
    for reason, rows in bad.items():
        text = rows if isinstance(rows, bytes) else json.dumps(rows).encode()
        changed = dataclasses.replace(parts, blobs={**parts.blobs, 'sessions.json': text})
        with pytest.raises(MapFileError, match=reason):
            read_map(written(tmp_path / 'a', changed))


VERSION_1 = Path(__file__).parent / 'map_version_1.dcgs'  # of `example`, by the writer of then


def test_a_map_of_version_1_is_read_and_its_tracker_made_up() -> None:
    saved, expected = read_map(VERSION_1), example()
    for name in ('ids', 'hosts', 'viewpoints', 'track_covariances', 'landmarks'):
        np.testing.assert_array_equal(getattr(saved, name), getattr(expected, name))
    np.testing.assert_array_equal(saved.splats.planes, expected.splats.planes)
    assert (saved.camera, saved.config) == (expected.camera, expected.config)
    assert (saved.version, expected.version) == (1, 3)
    tracker = saved.tracker
    np.testing.assert_array_equal(tracker.ids, saved.ids[saved.measured])
    np.testing.assert_array_equal(tracker.hosts, saved.hosts[saved.measured])
    np.testing.assert_array_equal(tracker.means, saved.splats.means.T[saved.measured])
    assert tracker.next_id > tracker.ids.max() and len(tracker.poses) == 2
    assert [k.keyframe for k in saved.keyframes] == [0, 1]
    (only,) = saved.sessions
    assert (only.camera, only.keyframes, only.views) == (saved.camera, 2, 2)


def test_a_map_of_version_2_is_read_and_its_edges_hold_all_directions() -> None:
    saved, expected = read_map(VERSION_1.with_name('map_version_2.dcgs')), example()
    assert (saved.version, saved.camera, saved.config) == (2, expected.camera, expected.config)
    np.testing.assert_array_equal(saved.tracker.edges, expected.tracker.edges)
    shares = np.array([0.7, 0.3])[:, None, None]
    np.testing.assert_allclose(saved.tracker.edge_information, shares * np.eye(6), atol=1e-12)


def changed(name: str, index: Any, value: float) -> dict[str, NDArray[Any]]:
    saved = example()
    array = saved.splats.planes if name == 'splats' else getattr(saved, name)
    array[index] = value
    return {name: array}


# What `SavedMap` and a file with the same array both refuse.
FAULTS: dict[str, tuple[dict[str, NDArray[Any]], str]] = {
    'few ids': ({'ids': np.arange(4)}, r'ids is int64 of shape \(4,\), not int64 of \(5,\)'),
    'short ids': (
        {'ids': np.arange(5, dtype=np.int32)},
        r'ids is int32 of shape \(5,\), not int6',
    ),
    'no axis': ({'hosts': np.zeros((), np.int32)}, r'hosts is int32 of shape \(\), not'),
    'many hosts': ({'hosts': np.zeros(6, np.int32)}, r'hosts is int32 of shape \(6,\)'),
    'double': ({'viewpoints': np.zeros((5, 3))}, 'viewpoints is float64'),
    'matrices': (
        {'track_covariances': np.zeros((5, 3, 3), np.float32)},
        r'track_covariances is float32 of shape \(5, 3, 3\), not float32 of \(5, 6\)',
    ),
    'flat': ({'landmarks': np.zeros(9)}, r'landmarks is .*\(9,\), not float64 of \(3, 3\)'),
    'one landmark': ({'landmarks': np.zeros((1, 3))}, r'landmark_covariances is .*of \(1, 3, 3\)'),
    'twice': (changed('ids', 0, 11), '5 Gaussians have only 4 different ids'),
    'host': (changed('hosts', slice(3), 2), 'hosts of 3 of 5 Gaussians, the first 2, .* 2 keyfr'),
    'no host': (changed('hosts', 1, -1), 'hosts of 1 of 5 Gaussians, the first -1, are none'),
    'nan': (changed('splats', (slice(3), 4), np.nan), 'splats: 1 of 5 are not finite'),
    'tracked': (changed('tracked_means', 0, np.nan), 'tracked_means: 1 of 5 are not finite'),
    'reach': (changed('reach_m', 0, np.nan), 'reach_m: some are no numbers'),
    'weights': ({'weights': np.zeros(5)}, 'weights is float64'),
    'infinity': (changed('splats', 0, np.inf), 'splats: 5 of 5 are not finite'),
    'viewpoint': (changed('viewpoints', 0, np.nan), 'viewpoints: 1 of 4 are not'),
    'covariance': (
        changed('track_covariances', (0, 1), np.nan),
        'track_covariances: 1 of 4 are not finite',
    ),
    'known': (
        changed('viewpoints', (4, 1), 0.0),
        'viewpoints: 1 of 5 are not finite',
    ),
    'own': (
        {
            'viewpoints': np.zeros((5, 3), np.float32),
            'track_covariances': np.zeros((5, 6), np.float32),
        },
        '1 Gaussians that the mapper spawned have viewpoints',
    ),
    'landmark': (changed('landmarks', (0, 0), np.inf), 'landmarks: 1 of 3 are not finite'),
    'landmark covariance': (
        changed('landmark_covariances', (2, 1, 1), np.nan),
        'landmark_covariances: 1 of 3 are not finite',
    ),
}


@pytest.mark.parametrize('fault', FAULTS)
def test_a_map_that_contradicts_itself_cannot_be_made(fault: str) -> None:
    changes, reason = FAULTS[fault]
    parts: dict[str, Any] = {
        name: Splats(value) if name == 'splats' else value for name, value in changes.items()
    }
    with pytest.raises(MapFileError, match=f'^{reason}'):
        dataclasses.replace(example(), **parts)


KEYFRAME_FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    'small pose': ({'T_world_cam': np.eye(3)}, r'T_world_cam is float64 of shape \(3, 3\)'),
    'float pose': ({'T_world_cam': np.eye(4, dtype=np.float32)}, 'T_world_cam is float32'),
    'lost': ({'T_world_cam': np.full((4, 4), np.nan)}, 'T_world_cam of the keyframe at 7 ns is'),
    'one gain': ({'exposure': np.ones(3, np.float32)}, r'exposure is float32 of shape \(3,\)'),
    'bright': (
        {'exposure': np.full((2, 3), np.inf, np.float32)},
        'exposure of the keyframe at 7 ns is not finite',
    ),
    'late': ({'stamp_ns': 2**63}, 'stamp 9223372036854775808 ns of a keyframe does not fit'),
}


@pytest.mark.parametrize('fault', KEYFRAME_FAULTS)
def test_a_keyframe_that_is_none_cannot_be_made(fault: str) -> None:
    changes, reason = KEYFRAME_FAULTS[fault]
    with pytest.raises(MapFileError, match=reason):
        keyframe(**changes)


def parts_of(path: Path) -> Archive:
    """Write a good map; return the contents of its archive, to be changed."""
    write_map(path, example())
    return read_archive(path)


def written(path: Path, parts: Archive) -> Path:
    write_archive(path, parts.arrays, parts.metadata, parts.blobs)
    return path


FILE_FAULTS: dict[str, tuple[dict[str, NDArray[Any]], str]] = FAULTS | {
    'planes': ({'splats': np.zeros((13, 5), np.float32)}, r'planes are \(13, 5\), not'),
    'halves': ({'splats': np.zeros((14, 5))}, 'planes are float64, not float32'),
    'stamps': ({'stamps_ns': np.zeros(2)}, 'stamps_ns is float64'),
    'one stamp': ({'stamps_ns': np.array(5)}, r'stamps_ns is int64 of shape \(\), not'),
    'poses': ({'poses': np.zeros((3, 4, 4))}, r'poses is .*\(3, 4, 4\), not .*\(2, 4, 4\)'),
    'exposures': ({'exposures': np.zeros((2, 6), np.float32)}, r'exposures is .*\(2, 6\), not'),
    'third frame': (
        {
            'stamps_ns': np.arange(3),
            'tracked': np.tile(np.eye(4), (3, 1, 1)),
            'poses': np.tile(np.eye(4), (3, 1, 1)),
            'exposures': np.ones((3, 2, 3), np.float32),
            'keyframe_numbers': np.zeros(3, np.int32),
            'visits': np.zeros(3, np.int32),
        },
        "holds no 'color_000002.jpg'",
    ),
    'lost': ({'poses': np.full((2, 4, 4), np.inf)}, 'T_world_cam of the keyframe at 0 ns is not'),
}


@pytest.mark.parametrize('fault', FILE_FAULTS)
def test_a_file_that_contradicts_itself_is_refused(tmp_path: Path, fault: str) -> None:
    changes, reason = FILE_FAULTS[fault]
    parts = parts_of(tmp_path / 'a.map')
    parts = dataclasses.replace(parts, arrays={**parts.arrays, **changes})
    with pytest.raises(MapFileError, match=rf'a\.map: {reason}'):
        read_map(written(tmp_path / 'a.map', parts))


def test_a_part_that_is_missing_is_named(tmp_path: Path) -> None:
    parts = parts_of(tmp_path / 'a.map')
    for group in ('arrays', 'metadata', 'blobs'):
        for name in getattr(parts, group):
            rest = {key: value for key, value in getattr(parts, group).items() if key != name}
            changes: dict[str, Any] = {group: rest}
            written(tmp_path / 'a.map', dataclasses.replace(parts, **changes))
            with pytest.raises(MapFileError, match=rf"a\.map: holds no '{name}'"):
                read_map(tmp_path / 'a.map')


CAMERA = dataclasses.asdict(example().camera)
BAD_METADATA: dict[str, tuple[str, Any, str]] = {
    'unknown setting': ('config', {'warp.factor': 9}, "unknown setting 'warp.factor'; the valid"),
    'range': ('config', {'cloud.stride_px': 1000}, 'stride_px is 1000, not within 2 to 64'),
    'sensor': ('config', {'sensor.a_m': -1.0}, 'need a_m > 0'),
    'kind': ('config', {'cloud.stride_px': [7]}, r'cloud.stride_px is \[7\], not a finite int'),
    'list of settings': ('config', [], 'config is a list, not settings'),
    'list of a camera': ('camera', [], 'camera is not usable: TypeError'),
    'no focal length': ('camera', {'width': 64, 'height': 48}, "camera is not usable: KeyE.*'fx'"),
    'half a pixel': ('camera', CAMERA | {'width': 64.5}, 'camera is not usable: TypeError'),
    'a word': ('camera', CAMERA | {'fx': 'long'}, "camera is not usable: ValueError: .*'long'"),
    'beyond double': ('camera', CAMERA | {'fx': 10**400}, 'camera is not usable: OverflowError'),
    'one coefficient': ('camera', CAMERA | {'distortion': [1.0]}, 'distortion has 1 numbers'),
    'tiny': ('camera', CAMERA | {'height': 1}, '64x1 pixels is smaller than 16x16'),
}


@pytest.mark.parametrize('fault', BAD_METADATA)
def test_a_camera_or_setting_that_is_none_is_refused(tmp_path: Path, fault: str) -> None:
    name, value, reason = BAD_METADATA[fault]
    parts = parts_of(tmp_path / 'a.map')
    parts = dataclasses.replace(parts, metadata={**parts.metadata, name: value})
    with pytest.raises(MapFileError, match=rf'a\.map: .*{reason}'):
        read_map(written(tmp_path / 'a.map', parts))


def test_settings_newer_than_the_file_have_their_defaults(tmp_path: Path) -> None:
    parts = parts_of(tmp_path / 'a')
    del parts.metadata['config']['cloud.stride_px']
    config = read_map(written(tmp_path / 'a', parts)).config
    expected = flatten(example().config) | {'cloud.stride_px': Config().cloud.stride_px}
    assert flatten(config) == expected


def test_what_is_no_archive_or_cannot_be_written_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / 'a.map'
    path.write_bytes(b'ply\n')
    with pytest.raises(MapFileError, match=r"a\.map: no archive: begins with b'ply"):
        read_map(path)
    with pytest.raises(MapFileError, match='cannot be read: No such file'):
        read_map(tmp_path / 'nowhere')

    def fail(*_: object) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'replace', fail)
    with pytest.raises(MapFileError, match=r'a\.map: cannot be written: No space left'):
        write_map(path, example())
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (b'ply\n', [path])


@contextlib.contextmanager
def bounded_memory(file_size: int) -> Iterator[None]:
    """Assert that the block takes no more than a few times the file's size."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 3 * file_size + MEMORY_SLACK


def read_or_refused(path: Path) -> bool:
    """Read within the bounds of memory; return whether that raised no `MapFileError`."""
    with bounded_memory(path.stat().st_size):
        try:
            read_map(path)
        except MapFileError:
            return False
    return True


def damaged(good: bytes, rng: np.random.Generator) -> bytearray:
    data = bytearray(good)
    for position in rng.integers(len(data), size=rng.integers(1, 4)):
        data[position] = rng.integers(256)
    return data


def test_damaged_files_are_read_or_refused_and_nothing_else(tmp_path: Path) -> None:
    path, rng = tmp_path / 'a', np.random.default_rng(2)
    write_map(path, example())
    good, read = unsealed_zip(path.read_bytes()), 0
    for trial in range(300):
        path.write_bytes(damaged(good, rng) if trial % 4 else good[: rng.integers(len(good))])
        read += read_or_refused(path)
    assert 0 < read < 150


@pytest.mark.slow
def test_forged_parts_are_read_or_refused_and_nothing_else(tmp_path: Path) -> None:
    """Damage numbers and settings in archives that are otherwise valid."""
    path, rng, read = tmp_path / 'a', np.random.default_rng(3), 0
    parts = parts_of(path)
    text = json.dumps(parts.metadata).encode()
    for trial in range(150):
        forged, metadata = dict(parts.arrays), parts.metadata
        if trial % 3:
            name = list(forged)[trial % len(forged)]
            array = forged[name]
            data = damaged(array.tobytes(), rng)
            forged[name] = np.frombuffer(data, array.dtype).reshape(array.shape)
        else:
            with contextlib.suppress(ValueError):
                metadata = json.loads(damaged(text, rng).decode('latin-1'))
        write_archive(path, forged, metadata, parts.blobs)
        read += read_or_refused(path)
    assert 0 < read < 150
