# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Taking a map of a running mapper, with the tracker in the same or another process."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.backend.features import Features
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.keyframe import Correction
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.core.mapping.rectification import DEPTH_UNIT_M, Images
from dcgs_ros.core.mapping.splats import Splats
from dcgs_ros.core.mapping.views import KeyframeView
from dcgs_ros.core.render.cpu import CpuRenderer
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.io import snapshot
from dcgs_ros.io.known_places import VIEW_DEPTH_UNIT_M, KnownView, features_of, places_of
from dcgs_ros.io.map_archive import MapFileError, SavedMap, read_map, write_map
from dcgs_ros.io.saved_tracker import SavedTracker
from dcgs_ros.io.snapshot import as_hosts_saw, restore_mapper, saved_map

CAMERA = PinholeCamera(64, 48, 60.0, 61.0, 31.5, 23.5)
RELATIVE = 1e-4
BLACK = Images(np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.uint16))
ELEMENTS = np.triu_indices(3)


def mapper_with(per_view: int = 20, views: int = 3) -> Mapper:
    """Return a mapper with Gaussians of the tracker (ids 100 host + k) and its own."""
    workers, rng = Workers(1), np.random.default_rng(4)
    mapper = Mapper(CAMERA, Config(), CpuRenderer(workers), workers)
    own = -1
    for k in range(views):
        T = se3.exp(rng.normal(size=6) * 0.3)
        view = KeyframeView.of(k, 10**9 + k, T, BLACK, None)
        view.T_world_cam = T @ se3.exp(0.05 * rng.normal(size=6))
        mapper.views.append(view)
        planes = rng.normal(size=(14, per_view)).astype(np.float32)
        planes[3:6] -= 4
        ids = 100 * k + np.arange(per_view, dtype=np.int64)
        ids[::4] = own - np.arange(len(ids[::4]))
        own = int(ids.min()) - 1
        measured = rng.uniform(-2, 2, (3, per_view)).astype(np.float32)
        reach_m = np.full(per_view, np.inf, np.float32)
        mapper.table.append(Splats(planes), ids, k, measured, reach_m)
    return mapper


def expected_covariance(mapper: Mapper, column: int) -> NDArray[np.float64]:
    """Return S(u, z; p) of the ray from the host to the Gaussian, both as tracked."""
    table, config = mapper.table, mapper.config
    host = mapper.views[table.hosts[column]].T_tracked[:3, 3]
    ray = table.measured[:, column] - host
    z = float(np.linalg.norm(ray))
    along = np.outer(ray, ray) / z**2
    sigma_perp = z * config.registration.anchor_px / CAMERA.focal
    sigma_par = config.sensor.a_m + config.sensor.b_per_m * z**2
    return sigma_perp**2 * (np.eye(3) - along) + sigma_par**2 * along


def test_what_the_tracker_measured_is_known_from_the_hosts() -> None:
    """In the tracker's world, however far the mapper has moved poses and means."""
    mapper = mapper_with()
    viewpoints, covariances = as_hosts_saw(mapper)
    table = mapper.table
    assert viewpoints.dtype == covariances.dtype == np.float32
    for k, id in enumerate(table.ids):
        if id < 0:
            assert np.isnan(viewpoints[k]).all() and np.isnan(covariances[k]).all()
            continue
        host = mapper.views[table.hosts[k]].T_tracked[:3, 3]
        np.testing.assert_array_equal(viewpoints[k], host.astype(np.float32))
        expected = expected_covariance(mapper, k)
        np.testing.assert_allclose(
            covariances[k], expected[ELEMENTS], rtol=RELATIVE, atol=RELATIVE * np.trace(expected)
        )


@pytest.mark.filterwarnings('error')
def test_what_has_no_covariance_is_not_measured_and_spoils_nothing(tmp_path: Path) -> None:
    """At the viewpoint itself, or too far away for float32."""
    mapper, good = mapper_with(), mapper_with()
    table = mapper.table
    table.measured[:, 1] = mapper.views[0].T_tracked[:3, 3].astype(np.float32)
    mapper.views[0].T_tracked[:3, 3] = table.measured[:, 1]
    good.views[0].T_tracked[:3, 3] = table.measured[:, 1]
    table.measured[:, 22], table.measured[:, 23] = 1e18, -3e38
    viewpoints, covariances = as_hosts_saw(mapper)
    bad = [1, 22, 23]
    assert np.isnan(viewpoints[bad]).all() and np.isnan(covariances[bad]).all()
    rest = np.setdiff1d(np.arange(len(table)), bad)
    for found, expected in zip((viewpoints, covariances), as_hosts_saw(good), strict=True):
        np.testing.assert_array_equal(found[rest], expected[rest])
    write_map(tmp_path / 'map.dcgs', saved_map(mapper, None))
    saved = read_map(tmp_path / 'map.dcgs')
    assert set(saved.ids[~saved.measured]) == set(table.ids[table.ids < 0]) | set(table.ids[bad])


def test_without_a_tracker_a_map_is_saved_whole_but_for_landmarks(tmp_path: Path) -> None:
    mapper = mapper_with()
    saved = saved_map(mapper, None)
    write_map(tmp_path / 'map.dcgs', saved)
    read = read_map(tmp_path / 'map.dcgs')
    np.testing.assert_array_equal(read.ids, mapper.table.ids)
    np.testing.assert_array_equal(read.hosts, mapper.table.hosts)
    np.testing.assert_array_equal(read.splats.planes, mapper.table.splats.planes)
    np.testing.assert_array_equal(read.measured, read.ids >= 0)
    assert read.landmarks.shape == (0, 3) and read.landmark_covariances.shape == (0, 3, 3)
    for keyframe, view in zip(read.keyframes, mapper.views, strict=True):
        np.testing.assert_array_equal(keyframe.T_world_cam, view.T_world_cam)
        np.testing.assert_array_equal(keyframe.T_tracked, view.T_tracked)


def test_what_is_saved_stays_as_it_was_when_the_mapper_goes_on() -> None:
    mapper = mapper_with()
    saved = saved_map(mapper, None)
    planes, ids = saved.splats.planes.copy(), saved.ids.copy()
    mapper.table.splats.planes[:] += 1
    mapper.table.ids[:] = 7
    np.testing.assert_array_equal(saved.splats.planes, planes)
    np.testing.assert_array_equal(saved.ids, ids)


def test_poisoned_gaussians_are_not_saved() -> None:
    mapper = mapper_with()
    gone = mapper.table.ids[[3, 5]].tolist()
    mapper.table.splats.planes[[0, 8], [3, 5]] = np.nan, np.inf
    saved = saved_map(mapper, None)
    assert not np.isin(gone, saved.ids).any() and len(saved.ids) == 58
    assert len(saved.viewpoints) == len(saved.track_covariances) == len(saved.hosts) == 58


def test_beside_a_tracker_what_it_has_counts() -> None:
    """Viewpoints are those of the last observation; NaN for removed Gaussians."""
    mapper = mapper_with(per_view=8, views=1)
    tracker = Tracker(CAMERA)
    rng, n = np.random.default_rng(5), 8
    means = rng.uniform(1, 2, (n, 3)).astype(np.float32)
    tracker.gaussians.restore(
        rng.permutation(n).astype(np.int64), means, -means, np.zeros(n, np.float32),
        np.tile(np.arange(n, dtype=np.float32)[:, None], (1, 3)), np.zeros(n, np.int32), n,
    )  # fmt: skip
    tracker.resume(tracker.gaussians, [np.eye(4)], [0])
    tracker.gaussians.remove(np.array([5]))
    saved = saved_map(mapper, tracker)
    there = {id: k for k, id in enumerate(tracker.gaussians.ids.tolist()) if id >= 0}
    for k, id in enumerate(saved.ids.tolist()):
        if id not in there:
            assert np.isnan(saved.viewpoints[k]).all()
        else:
            expected = tracker.gaussians.viewpoints[there[id]]
            np.testing.assert_array_equal(saved.viewpoints[k], expected)
    assert saved.measured.sum() == 5  # of 8, 0 and 4 are the mapper's own, 5 is gone


def test_an_empty_map_can_be_saved() -> None:
    workers = Workers(1)
    mapper = Mapper(CAMERA, Config(), CpuRenderer(workers), workers)
    saved = saved_map(mapper, None)
    assert len(saved.splats) == 0 and not saved.keyframes


def same_bytes(tmp_path: Path, one: SavedMap, other: SavedMap) -> bool:
    write_map(tmp_path / 'one', one)
    write_map(tmp_path / 'other', other)
    return (tmp_path / 'one').read_bytes() == (tmp_path / 'other').read_bytes()


def test_saved_loaded_and_saved_again_is_the_same_file(tmp_path: Path) -> None:
    mapper = mapper_with()
    mapper.table.weights[:] = np.arange(len(mapper.table))
    mapper.table.place_anchors(np.array([view.T_map_tracked for view in mapper.views]))
    saved = saved_map(mapper, None, 'day 1')
    workers = Workers(1)
    again = Mapper(CAMERA, Config(), CpuRenderer(workers), workers)
    restore_mapper(again, saved)
    assert same_bytes(tmp_path, saved, saved_map(again, None, 'day 2', saved.sessions))
    np.testing.assert_allclose(again.table.anchors, mapper.table.anchors, atol=1e-5)
    assert again._next_own_id == mapper.table.ids.min() - 1


def test_a_restored_mapper_shares_nothing_with_the_saved_map() -> None:
    saved, workers = saved_map(mapper_with(), None), Workers(1)
    planes = saved.splats.planes.copy()
    again = Mapper(CAMERA, Config(), CpuRenderer(workers), workers)
    restore_mapper(again, saved, first_id=1000)
    again.table.splats.planes[0] += 1
    again.views[0].exposure.gain[:] = 7
    np.testing.assert_array_equal(saved.splats.planes, planes)
    assert (saved.keyframes[0].exposure[0] == 1).all()
    assert saved_map(again, None, first_id=1000).ids.tolist() == saved.ids.tolist()


def test_another_camera_is_refused() -> None:
    workers = Workers(1)
    mapper = Mapper(replace(CAMERA, fx=59.0), Config(), CpuRenderer(workers), workers)
    with pytest.raises(MapFileError, match=r'another camera: 64x48, fx 60 .*, not 64x48, fx 59 '):
        restore_mapper(mapper, saved_map(mapper_with(), None))
    assert not mapper.views and not len(mapper.table)


def test_views_without_gaussians_of_the_tracker_are_no_keyframes() -> None:
    mapper = mapper_with()
    mapper.table.ids[mapper.table.hosts == 1] = -1000 - np.arange(20)
    saved = saved_map(mapper, None)
    assert [view.keyframe for view in saved.keyframes] == [0, -1, 1]
    tracker = saved.tracker
    assert tracker.stamps_ns.tolist() == [10**9, 10**9 + 2]
    np.testing.assert_array_equal(tracker.poses[1], mapper.views[2].T_tracked)
    rows = {id: k for k, id in enumerate(mapper.table.ids.tolist())}
    for k, id in enumerate(tracker.ids.tolist()):
        np.testing.assert_array_equal(tracker.means[k], mapper.table.measured[:, rows[id]])
        assert tracker.hosts[k] == mapper.table.hosts[rows[id]] // 2
        assert tracker.normals[k] @ (tracker.means[k] - tracker.viewpoints[k]) <= 0


def test_a_tracker_saved_and_resumed_has_the_same_map() -> None:
    """Ids that were removed are not given out again; odometry, sub-maps and observers stay."""
    source = SyntheticSource.from_address('synthetic:room?frames=8&speed=2')
    often = {'keyframes.translation_m': 0.01, 'keyframes.min_interval_s': 0.0}
    tracker = Tracker(source.camera, override(Config(sensor=source.sensor), often))
    for frame in source:
        tracker.track(frame)
    tracker.gaussians.remove(tracker.gaussians.ids[-3:].copy())
    saved = SavedTracker.of(tracker)
    again = Tracker(source.camera, tracker.config)
    saved.resume(again, source.camera)
    for name, array in SavedTracker.of(again).parts.items():
        np.testing.assert_array_equal(array, saved.parts[name], err_msg=name)
    assert again.gaussians.next_id == tracker.gaussians.next_id == saved.ids.max() + 4
    assert again.keyframes == len(saved.poses) >= 3
    assert (saved.observers != saved.hosts).any()
    expected, found = tracker.visited.odometries[1], again.visited.odometries[1]
    assert expected is not None and found is not None
    np.testing.assert_array_equal(found.T_host_cam, expected.T_host_cam)
    np.testing.assert_array_equal(found.hosts, expected.hosts)


def test_a_restored_map_moves_with_its_keyframes() -> None:
    """Also after a correction that names the keyframes of the sessions before."""
    mapper, workers = mapper_with(), Workers(1)
    saved = saved_map(mapper, None)
    again = Mapper(CAMERA, Config(), CpuRenderer(workers), workers)
    restore_mapper(again, saved)
    motion = se3.exp(np.array([0.1, 0.2, 0.3, 0.1, 0.0, 0.2]))
    stamps, poses = saved.tracker.stamps_ns, saved.tracker.poses
    count = len(stamps)
    moved = Correction(
        1, stamps, motion @ poses, np.zeros((count, 6, 6)), np.zeros(count, np.int32)
    )
    assert again.correct(moved) == count
    expected = se3.transform(motion, saved.splats.means.T)
    np.testing.assert_allclose(again.table.splats.means.T, expected, atol=1e-4)


def test_features_are_found_once_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mapper, seen = mapper_with(), list[bytes]()
    features = Features(
        np.full((2, 32), 7, np.uint8), np.ones((2, 2), np.float32), np.ones(2, np.float32)
    )

    def found(color_jpeg: bytes, *_: object) -> Features:
        seen.append(color_jpeg)
        return features

    monkeypatch.setattr(snapshot, 'extracted', found)
    for _ in range(2):
        write_map(tmp_path / 'a', saved_map(mapper, None))
    assert seen == [view.encoded[0] for view in mapper.views]
    again = Mapper(CAMERA, Config(), CpuRenderer(Workers(1)), Workers(1))
    saved = read_map(tmp_path / 'a')
    restore_mapper(again, saved)
    saved_again = saved_map(again, None)
    assert len(seen) == len(mapper.views)
    kept, once_more = saved.keyframes[-1].features, saved_again.keyframes[-1].features
    assert kept is not None and once_more is kept
    for name in ('descriptors', 'rays', 'depths_m'):
        np.testing.assert_array_equal(getattr(kept, name), getattr(features, name))
    assert features_of([KnownView(3, b'', b'', kept)], CAMERA, Config().sensor) == [(3, kept)]


def test_places_of_a_map_are_known_again() -> None:
    assert VIEW_DEPTH_UNIT_M == DEPTH_UNIT_M
    source = SyntheticSource.from_address('synthetic:room?frames=2')
    config = Config(sensor=source.sensor)
    frame = next(iter(source))
    assert isinstance(frame, RgbdFrame)
    color = cv2.imencode('.jpg', frame.color[..., ::-1])[1].tobytes()
    depth = np.rint(frame.depth_m / VIEW_DEPTH_UNIT_M).astype(np.uint16)
    png = cv2.imencode('.png', depth)[1].tobytes()
    pairs = [(b'', b''), (b'no', b'image'), (color, png[:50]), (color, color), (color, png)]
    views = [KnownView(k, *pair) for k, pair in enumerate(pairs)]
    features = features_of(views, source.camera, source.sensor)
    assert [keyframe for keyframe, _ in features] == [4]
    places = places_of(features, source.camera, config)
    assert places is not None and places_of([], source.camera, config) is None
    found = places.recognise(frame)[0]
    assert found.keyframe == 4 and np.linalg.norm(se3.log(found.T_keyframe_cam)) < 0.02
