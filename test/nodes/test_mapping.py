# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The mapper node's map: what begins one, what is refused, what is saved."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config import Config, override
from dcgs_ros.core.errors import DcgsError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.mapper import Keyframe, Mapper
from dcgs_ros.io.map_archive import read_map
from dcgs_ros.io.ply import read_ply
from dcgs_ros.nodes.mapping import Mapping
from dcgs_ros.nodes.offers import Offer

CAMERA = PinholeCamera(48, 36, 42.0, 42.0, 23.5, 17.5)
LARGER = PinholeCamera(64, 48, 56.0, 56.0, 31.5, 23.5)
SMALLEST = PinholeCamera(16, 16, 14.0, 14.0, 7.5, 7.5)
RESTING_STEPS = 7
CONFIG = override(
    Config(), {'threads': 1, 'mapping.final_steps': RESTING_STEPS, 'mapping.trial_visits': 1000}
)
WALL_M = 1.5


def offer_of(
    index: int, epoch: int = 5, first_id: int | None = None, camera: PinholeCamera = CAMERA
) -> Offer:
    """Offer a keyframe of a wall, from a place of its own; epoch 0: a view without Gaussians."""
    T = se3.exp(np.array([0.05 * index, -0.02 * index, 0.0, 0.0, 0.01 * index, 0.0]))
    rays = np.ones((camera.height, camera.width, 3))
    rays[..., :2] = camera.undistortion_map
    directions = rays @ T[:3, :3].T
    depth_m = (WALL_M - T[2, 3]) / directions[..., 2]
    points = T[:3, 3] + depth_m[..., None] * directions
    waves = np.sin(np.array([9.0, 7.0, 11.0]) * (points[..., :1] + 0.5 * points[..., 1:2]))
    color = np.round(127 + 100 * waves).astype(np.uint8)
    stamp_ns = 10**9 + index
    means = points[2::5, 2::5].reshape(-1, 3).astype(np.float32)[: None if epoch else 0]
    first = 1000 * index if first_id is None else first_id
    keyframe = Keyframe(
        RgbdFrame(stamp_ns, stamp_ns, color, depth_m.astype(np.float32)), T, np.eye(4),
        first + np.arange(len(means), dtype=np.int64), means,
        np.tile(np.array([0, 0, -1], np.float32), (len(means), 1)),
    )  # fmt: skip
    return Offer(epoch, camera, keyframe)


def changed(offer: Offer, **values: Any) -> Offer:
    return replace(offer, keyframe=replace(offer.keyframe, **values))


def tracked_ids(mapping: Mapping) -> set[int]:
    assert mapping.mapper is not None
    ids = mapping.mapper.table.ids
    return set(ids[ids >= 0].tolist())


def state(mapping: Mapping) -> tuple[Mapper | None, int, set[int], bytes, int]:
    mapper = mapping.mapper
    planes = mapper.table.splats.planes.tobytes() if mapper is not None else b''
    views = len(mapper.views) if mapper is not None else 0
    return mapper, mapping.epoch, set(mapping.stamps), planes, views


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def mapping(said: list[str]) -> Iterator[Mapping]:
    mapping = Mapping(CONFIG, said.append)
    yield mapping
    mapping.close()


def test_before_any_keyframe_there_is_nothing_and_nothing_to_do(mapping: Mapping) -> None:
    assert mapping.take(offer_of(0, epoch=0)) is None
    assert not mapping.advance()
    assert mapping.view(0, np.eye(4)) is None
    mapping.reconfigure(CONFIG)
    mapping.reset()
    assert mapping.mapper is None and mapping.epoch == 0 and not mapping.stamps


def test_keyframes_and_views_of_a_map_go_into_it(mapping: Mapping, said: list[str]) -> None:
    offers = [offer_of(0), offer_of(1, epoch=0), offer_of(2)]
    for offer in offers:
        assert mapping.take(offer) is not None
    assert mapping.mapper is not None and len(mapping.mapper.views) == 3
    assert mapping.epoch == 5 and mapping.stamps == {10**9, 10**9 + 1, 10**9 + 2}
    assert tracked_ids(mapping) == {int(k) for offer in offers for k in offer.keyframe.ids}
    assert not said


@pytest.mark.parametrize('epoch', [0, 5])
def test_a_keyframe_that_is_here_already_changes_nothing(mapping: Mapping, epoch: int) -> None:
    """Offered once more since its acknowledgement was late, perhaps with more than it had."""
    mapping.take(offer_of(0))
    assert mapping.take(offer_of(1, epoch)) is not None
    before = state(mapping)
    assert mapping.take(offer_of(1, epoch)) is None
    assert mapping.take(offer_of(1, 5, first_id=7000)) is None
    assert state(mapping) == before and mapping.refused == 0


def test_a_late_keyframe_brings_what_is_not_here_yet(mapping: Mapping) -> None:
    """Where the tracker's memory was short one keyframe brings the Gaussians of two."""
    mapping.take(offer_of(0))
    mapping.take(offer_of(2))
    late, here = offer_of(1).keyframe, offer_of(2).keyframe
    both = replace(
        late, ids=np.concatenate([late.ids, here.ids]),
        means=np.concatenate([late.means, here.means]),
        normals=np.concatenate([late.normals, here.normals]),
    )  # fmt: skip
    assert mapping.take(replace(offer_of(1), keyframe=both)) is not None
    assert mapping.mapper is not None
    ids = mapping.mapper.table.ids
    assert len(np.unique(ids)) == len(ids)
    hosts = dict(zip(ids.tolist(), mapping.mapper.table.hosts.tolist(), strict=True))
    assert {hosts[k] for k in here.ids.tolist()} == {1}
    assert {hosts[k] for k in late.ids.tolist()} == {2}


def test_another_epoch_begins_another_map_and_says_so(mapping: Mapping, said: list[str]) -> None:
    mapping.take(offer_of(0))
    first = mapping.mapper
    assert mapping.take(offer_of(0, epoch=6, first_id=50)) is not None
    assert mapping.mapper is not first and mapping.epoch == 6
    assert tracked_ids(mapping) == set(offer_of(0, first_id=50).keyframe.ids.tolist())
    assert len(said) == 1 and 'new map' in said[0]


def test_another_epoch_may_have_another_camera(mapping: Mapping) -> None:
    mapping.take(offer_of(0))
    assert mapping.take(offer_of(1, epoch=6, camera=LARGER)) is not None
    assert mapping.mapper is not None and mapping.mapper.camera == LARGER
    shown = mapping.view(0, np.eye(4))
    assert shown is not None and shown.color.shape == (3, 48, 64)


def nothing_measured(offer: Offer) -> Offer:
    return changed(offer, T_world_cam=np.full((4, 4), np.nan))


UNUSABLE: dict[str, Callable[[Offer], Offer]] = {
    'pose': nothing_measured,
    'motion': lambda offer: changed(offer, T_colour_depth=np.full((4, 4), np.inf)),
    'size': lambda offer: replace(offer, camera=LARGER, keyframe=offer_of(3).keyframe),
    'rows': lambda offer: changed(offer, means=offer.keyframe.means[:-1]),
    'twice': lambda offer: changed(offer, ids=np.repeat(offer.keyframe.ids[::2], 2)),
}


@pytest.mark.parametrize('fault', UNUSABLE)
@pytest.mark.parametrize('epoch', [5, 6])
def test_what_cannot_be_used_is_counted_said_and_costs_nothing(
    mapping: Mapping, said: list[str], fault: str, epoch: int
) -> None:
    """Not even, where it is of another epoch, the map that there is."""
    mapping.take(offer_of(0))
    before = state(mapping)
    bad = UNUSABLE[fault](offer_of(2, epoch))
    if fault == 'size' and epoch == 5:
        bad = replace(bad, keyframe=offer_of(2, camera=LARGER).keyframe)
    assert mapping.take(bad) is None
    assert state(mapping) == before
    assert mapping.refused == 1 and len(said) == 1 and 'refused' in said[0]
    assert mapping.take(offer_of(2, epoch)) is not None  # the same one, whole
    assert mapping.epoch == epoch


def test_a_camera_that_changes_size_within_an_epoch_is_refused_frame_by_frame(
    mapping: Mapping, said: list[str]
) -> None:
    mapping.take(offer_of(0))
    for k, epoch in enumerate((5, 0, 5), start=1):
        assert mapping.take(offer_of(k, epoch, camera=LARGER)) is None
    assert mapping.refused == 3 and '64x48' in said[0]
    assert mapping.take(offer_of(4)) is not None
    assert mapping.mapper is not None and len(mapping.mapper.views) == 2


@pytest.mark.parametrize('camera', [SMALLEST, PinholeCamera(17, 19, 15.0, 15.0, 8.0, 9.0)])
def test_the_smallest_cameras_are_mapped_too(mapping: Mapping, camera: PinholeCamera) -> None:
    for k in range(2):
        assert mapping.take(offer_of(k, camera=camera)) is not None
    for _ in range(RESTING_STEPS):
        assert mapping.advance()
    assert mapping.mapper is not None and np.isfinite(mapping.mapper.table.planes).all()


def test_a_map_that_had_its_steps_rests_until_something_comes(mapping: Mapping) -> None:
    mapping.take(offer_of(0))
    for _ in range(2):
        assert [mapping.advance() for _ in range(RESTING_STEPS + 2)] == [True] * 7 + [False] * 2
        assert mapping.take(offer_of(0)) is None and not mapping.advance()
        mapping.take(offer_of(1, epoch=0))


def test_after_a_reset_everything_may_come_again(mapping: Mapping) -> None:
    mapping.take(offer_of(0))
    mapping.take(offer_of(1))
    mapping.reset()
    assert mapping.take(offer_of(2, epoch=0)) is None
    for k in (1, 0):
        assert mapping.take(offer_of(k)) is not None
    assert mapping.mapper is not None and len(mapping.mapper.views) == 2
    found = mapping.view(10**9, np.eye(4))
    assert found is not None and np.isfinite(found.color).all()


def test_settings_that_change_hold_for_this_map_and_the_next(mapping: Mapping) -> None:
    mapping.take(offer_of(0))
    mapping.reconfigure(override(CONFIG, {'mapping.final_steps': 2}))
    assert [mapping.advance() for _ in range(4)] == [True, True, False, False]
    mapping.take(offer_of(0, epoch=6))
    assert [mapping.advance() for _ in range(4)] == [True, True, False, False]


@pytest.mark.filterwarnings('error')
def test_a_map_is_saved_whole_and_read_again(mapping: Mapping, tmp_path: Path) -> None:
    for k in range(3):
        mapping.take(offer_of(k, epoch=5 if k != 1 else 0))
    for _ in range(5):
        mapping.advance()
    texts = [mapping.save(tmp_path / 'deep' / 'runs') for _ in range(2)]
    folders = sorted((tmp_path / 'deep' / 'runs').iterdir())
    assert [text.rpartition(' in ')[2] for text in texts] == [str(folder) for folder in folders]
    saved = read_map(folders[1] / 'map.dcgs')
    assert mapping.mapper is not None
    np.testing.assert_array_equal(saved.ids, mapping.mapper.table.ids)
    np.testing.assert_array_equal(saved.splats.planes, mapping.mapper.table.splats.planes)
    np.testing.assert_array_equal(saved.measured, saved.ids >= 0)
    assert [k.stamp_ns for k in saved.keyframes] == [10**9, 10**9 + 1, 10**9 + 2]
    assert len(read_ply(folders[1] / 'map.ply')) == len(saved.ids)
    assert mapping.take(offer_of(4)) is not None  # and it goes on


def test_without_a_map_there_is_nothing_to_save(mapping: Mapping, tmp_path: Path) -> None:
    with pytest.raises(DcgsError, match='no map'):
        mapping.save(tmp_path / 'runs')
    assert not (tmp_path / 'runs').exists()


def test_a_folder_that_cannot_be_written_is_refused_in_words(
    mapping: Mapping, tmp_path: Path
) -> None:
    mapping.take(offer_of(0))
    before = state(mapping)
    file = tmp_path / 'file'
    file.write_text('')
    places = [file, file / 'below', Path('/proc/nothing'), tmp_path / ('x' * 300)]
    if os.getuid() != 0:  # root may write anywhere
        locked = tmp_path / 'locked'
        locked.mkdir(mode=0o500)
        places.append(locked)
    for folder in places:
        with pytest.raises(DcgsError, match=str(folder)):
            mapping.save(folder)
    assert state(mapping) == before


def test_a_full_disk_is_told_of(
    mapping: Mapping, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapping.take(offer_of(0))

    def full(*_: object, **__: object) -> int:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'replace', full)
    monkeypatch.setattr(Path, 'replace', full)
    with pytest.raises(DcgsError, match='No space left'):
        mapping.save(tmp_path)


HOSTILE = st.sampled_from(
    [0.0, 1e-30, 1e-3, 1.0, -1.0, 1e6, 1e18, 1e30, 3e38, -3e38, np.nan, np.inf, -np.inf]
)


@pytest.mark.slow
@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    means=st.lists(st.tuples(HOSTILE, HOSTILE, HOSTILE), min_size=1, max_size=6),
    normals=st.lists(st.tuples(HOSTILE, HOSTILE, HOSTILE), min_size=6, max_size=6),
    off=st.tuples(*[st.sampled_from([0.0, 0.3, -2.0, 100.0, 1e5])] * 6),
)
@pytest.mark.filterwarnings('ignore::RuntimeWarning')  # of numbers that are beyond float32
def test_gaussians_from_nowhere_neither_stop_the_mapper_nor_spoil_what_it_saves(
    means: list[tuple[float, ...]], normals: list[tuple[float, ...]], off: tuple[float, ...],
    tmp_path: Path,
) -> None:  # fmt: skip
    mapping = Mapping(CONFIG, lambda _: None)
    mapping.take(offer_of(0))
    n = len(means)
    mean_rows, normal_rows = (np.array(rows, np.float32) for rows in (means, normals[:n]))
    ids = 5000 + np.arange(n, dtype=np.int64)
    bad = changed(
        offer_of(1), ids=ids, means=mean_rows, normals=normal_rows,
        T_world_cam=se3.exp(np.array(off)),
    )  # fmt: skip
    assert mapping.take(bad) is not None
    for _ in range(3):
        mapping.advance()
    assert mapping.mapper is not None
    assert np.isfinite(loss_of(mapping.mapper))
    text = mapping.save(tmp_path)
    saved = read_map(Path(text.rpartition(' in ')[2]) / 'map.dcgs')
    own = set(offer_of(0).keyframe.ids.tolist())
    assert own <= set(saved.ids[saved.measured].tolist())


def loss_of(mapper: Mapper) -> float:
    return mapper.step(rate=0.0)


def test_the_map_is_that_of_the_wall(mapping: Mapping) -> None:
    """The whole way once: what is rendered is what the camera saw."""
    mapping.reconfigure(override(CONFIG, {'mapping.final_steps': 200}))
    for k in range(3):
        mapping.take(offer_of(k))
    while mapping.advance():
        pass
    seen = offer_of(1).keyframe
    shown = mapping.view(seen.frame.stamp_ns, seen.T_world_cam)
    assert shown is not None
    difference: NDArray = shown.color - np.moveaxis(seen.frame.color, -1, 0) / 255.0
    assert -10 * np.log10(np.mean(difference**2)) > 25.0
