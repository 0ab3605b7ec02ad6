# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A mirror of the map is the map, however late it subscribed; a tracker goes on in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

pytest.importorskip('sensor_msgs')

from dcgs_ros.core import se3
from dcgs_ros.core.config.stages import Config
from dcgs_ros.nodes.messages.clouds import MAP_GAUSSIAN
from dcgs_ros.nodes.messages.ids import EPOCH
from dcgs_ros.nodes.messages.maps import changes
from dcgs_ros.nodes.tracking.map_mirror import MapMirror, Resumable

KEPT = 32  # updates that a late subscriber still gets
FLOAT32 = 1e-5
FIELDS = MAP_GAUSSIAN.names or ()
LATER_NS = 10**6  # than all else
QUICK = settings(max_examples=50, deadline=None)

Message = tuple[str, int, NDArray[Any]]  # topic, stamp, rows


def rows_of(ids: Sequence[int], seed: int = 0) -> NDArray[Any]:
    """Rows in ascending order of id, the mapper's own without a tracking covariance."""
    rows = np.zeros(len(ids), MAP_GAUSSIAN)
    numbers = np.random.default_rng(seed).normal(size=(len(FIELDS), len(ids)))
    for name, values in zip(FIELDS, numbers, strict=True):
        rows[name] = 10 * values if name == 'keyframe' else values
    rows['id'] = sorted(ids)
    rows['track_cov_xx'][rows['id'] < 0] = np.nan
    return rows


def assert_same(rows: NDArray[Any] | None, expected: NDArray[Any]) -> None:
    """Compare bit by bit, without the padding between fields."""
    assert rows is not None and len(rows) == len(expected)
    for name in FIELDS:
        one, other = (np.ascontiguousarray(r[name]).view(np.uint8) for r in (rows, expected))
        np.testing.assert_array_equal(one, other, err_msg=name)


SEEDS = st.integers(0, 2**32 - 1)
IDS = st.sets(st.integers(-6, 6).map(lambda k: k if k < 0 else 7 * EPOCH + k))


@st.composite
def histories(draw: st.DrawFn) -> list[NDArray[Any]]:
    """Successive maps: some rows stay, some change, some are removed, some are added."""
    maps = [rows_of([])]
    for _ in range(draw(st.integers(1, 6))):
        ids = np.array(sorted(draw(IDS)), np.int64)
        rng, rows = np.random.default_rng(draw(SEEDS)), rows_of(ids.tolist(), draw(SEEDS))
        before = maps[-1]
        stays = np.isin(rows['id'], before['id']) & (rng.random(len(rows)) < 0.6)
        rows[stays] = before[np.isin(before['id'], rows['id'][stays])]
        maps.append(rows)
    return maps


@QUICK
@given(histories())
def test_changes_are_what_changed_and_no_more(maps: list[NDArray[Any]]) -> None:
    for before, now in pairwise(maps):
        news = changes(before, now)
        was = {row['id']: row.tobytes() for row in before}
        now_is = {row['id']: row.tobytes() for row in now}
        removed = np.isnan(news['x'])
        assert set(news['id'][removed]) == was.keys() - now_is.keys()
        expected = {id for id, row in now_is.items() if was.get(id) != row}
        assert set(news['id'][~removed]) == expected and len(set(news['id'])) == len(news)
        for row in news[~removed]:
            assert row.tobytes() == now_is[row['id']]
        for name in FIELDS:
            if name not in ('id', 'keyframe'):
                assert np.isnan(news[name][removed]).all()


@dataclass
class Publisher:
    """What the mapper's topics carried, and what late subscribers still get of it."""

    messages: list[Message]

    def seen_from(self, start: int) -> tuple[list[Message], list[Message]]:
        """Return what a subscriber after `start` messages gets: whole maps, updates."""
        past, to_come = self.messages[:start], self.messages[start:]
        topics = []
        for topic, depth in (('whole', 1), ('update', KEPT)):
            kept = [message for message in past if message[0] == topic][-depth:]
            topics.append(kept + [message for message in to_come if message[0] == topic])
        return topics[0], topics[1]


def published(
    maps: list[NDArray[Any]], wholes: Sequence[bool], stamp_ns: int = 100
) -> list[Message]:
    """Return an update for each map, and a whole map with the first and some others."""
    messages: list[Message] = []
    for k, (before, now) in enumerate(pairwise(maps)):
        messages.append(('update', stamp_ns + k, changes(before, now)))
        if k == 0 or wholes[k % len(wholes)]:
            messages.append(('whole', stamp_ns + k, now))
    return messages


def feed(mirror: MapMirror, topics: tuple[list[Message], list[Message]], seed: int) -> None:
    """Deliver each topic in order, the two of them interleaved at random."""
    waiting, rng = [list(topic) for topic in topics], np.random.default_rng(seed)
    while any(waiting):
        topic = waiting[rng.integers(2)]
        if topic:
            kind, stamp_ns, rows = topic.pop(0)
            getattr(mirror, kind)(stamp_ns, rows.copy())


WHOLES = st.lists(st.booleans(), min_size=1, max_size=8)


@QUICK
@given(histories(), WHOLES, st.integers(0, 20), SEEDS)
def test_a_mirror_is_the_map_however_late_it_comes_and_however_topics_interleave(
    maps: list[NDArray[Any]], wholes: list[bool], start: int, seed: int
) -> None:
    publisher, mirror = Publisher(published(maps, wholes)), MapMirror()
    feed(mirror, publisher.seen_from(start), seed)
    assert_same(mirror.rows, maps[-1])


@QUICK
@given(histories(), WHOLES, histories(), WHOLES, st.integers(90, 110), SEEDS)
def test_a_mirror_changes_over_to_another_mapper(
    maps: list[NDArray[Any]], wholes: list[bool], others: list[NDArray[Any]],
    other_wholes: list[bool], stamp_ns: int, seed: int,
) -> None:  # fmt: skip
    """One that was restarted, at the latest with its next whole map.

    Its stamps may be older, since views do not come again, and lie among those of the other.
    """
    mirror = MapMirror()
    feed(mirror, Publisher(published(maps, wholes)).seen_from(0), seed)
    assert_same(mirror.rows, maps[-1])
    again = published(others, other_wholes, stamp_ns)
    feed(mirror, Publisher(again).seen_from(0), seed + 1)
    mirror.whole(LATER_NS, others[-1])
    assert_same(mirror.rows, others[-1])


@QUICK
@given(histories())
def test_updates_alone_are_no_map(maps: list[NDArray[Any]]) -> None:
    """Without a whole map there are no rows."""
    mirror = MapMirror()
    for k, (before, now) in enumerate(pairwise(maps)):
        mirror.update(k, changes(before, now))
        assert mirror.rows is None
    mirror.whole(0, maps[1])
    assert_same(mirror.rows, maps[-1])


def test_as_many_updates_as_are_kept_wait_for_the_whole_map() -> None:
    maps = [rows_of(range(k + 1), seed=k) for k in range(KEPT + 1)]
    mirror = MapMirror()
    for k in range(KEPT):
        mirror.update(k + 1, changes(maps[k], maps[k + 1]))
    mirror.whole(0, maps[0])
    assert_same(mirror.rows, maps[-1])


@QUICK
@given(IDS, SEEDS)
def test_the_order_of_rows_does_not_matter(ids: set[int], seed: int) -> None:
    rows = rows_of(sorted(ids), seed)
    mirror = MapMirror()
    mirror.whole(1, np.random.default_rng(seed).permutation(rows))
    assert_same(mirror.rows, rows)


def test_an_empty_map_is_one_too() -> None:
    mirror, rows = MapMirror(), rows_of(range(-3, 4))
    mirror.whole(1, rows)
    mirror.update(2, changes(rows, rows[:0]))
    assert_same(mirror.rows, rows[:0])
    mirror.update(3, changes(rows[:0], rows))
    assert_same(mirror.rows, rows)
    assert not len(changes(rows[:0], rows[:0]))


# Going on in a map.

POSES = [se3.exp(np.array([0.3 * k, 0.1, -0.2 * k, 0.1 * k, 0.2, 0.05 * k])) for k in range(3)]
STAMPS = [10, 20, 30]


def tracked_rows(count: int = 60, epoch: int = 5) -> NDArray[Any]:
    """Return well-formed discs in front of the keyframes."""
    rng = np.random.default_rng(3)
    rows = rows_of([epoch * EPOCH + 3 * k for k in range(count)])
    rows['keyframe'] = rng.integers(0, len(POSES), count)
    for k in range(count):
        T = POSES[rows['keyframe'][k]]
        point = T[:3, :3] @ np.array([*rng.uniform(-0.5, 0.5, 2), 1.5]) + T[:3, 3]
        rows['x'][k], rows['y'][k], rows['z'][k] = point
    for k in range(3):
        rows[f'scale_{k}'] = np.exp(rng.uniform(-6, -3, count))
    quats = rng.normal(size=(4, count))
    for k in range(4):
        rows[f'rot_{k}'] = (quats / np.linalg.norm(quats, axis=0))[k]
    return rows


def test_a_tracker_gets_its_gaussians_back_with_their_ids() -> None:
    rows = tracked_rows()
    resumable = Resumable.of(np.concatenate([rows_of(range(-9, 0)), rows]), POSES, STAMPS)
    assert resumable is not None and resumable.epoch == 5
    assert resumable.stamps_ns == (10, 20, 30)
    gaussians = resumable.gaussians(Config())
    ids = (rows['id'] - 5 * EPOCH).astype(np.int64)
    assert len(gaussians) == len(rows) and gaussians.alive(ids).all()
    means = np.stack([rows[axis] for axis in 'xyz'], axis=1)
    found, normals = gaussians.of(ids)
    np.testing.assert_array_equal(found, means)
    viewpoints = np.array([POSES[k][:3, 3] for k in rows['keyframe']])
    np.testing.assert_allclose(gaussians.viewpoints, viewpoints, atol=FLOAT32)
    np.testing.assert_array_equal(gaussians.hosts, rows['keyframe'])
    assert (np.einsum('ij,ij->i', normals, viewpoints - means) >= -FLOAT32).all()
    for k, row in enumerate(rows):
        T = se3.from_quaternion(np.array([row[f'rot_{n}'] for n in range(4)], float), np.zeros(3))
        scales = np.array([row[f'scale_{n}'] for n in range(3)], float)
        thinnest = T[:3, np.argmin(scales)]
        assert abs(thinnest @ normals[k]) == pytest.approx(1, abs=FLOAT32)
        first, second, _ = np.sort(scales)
        flatness = gaussians.flatness[k]
        assert flatness == pytest.approx((first / second) ** 2, rel=1e-4)


def test_new_ids_are_none_that_the_last_tracker_may_have_given() -> None:
    resumable = Resumable.of(tracked_rows(), POSES, STAMPS)
    assert resumable is not None
    gaussians = resumable.gaussians(Config())
    n, highest = 4, 3 * 59
    new = gaussians.add(
        np.ones((n, 3), np.float32), np.ones((n, 3), np.float32), np.zeros(n, np.float32),
        np.zeros(3), 3,
    )  # fmt: skip
    assert new.min() > highest + 10_000 and len(gaussians) == 64


def test_where_a_tracker_has_nothing_there_is_nothing_to_go_on_in() -> None:
    rows = tracked_rows()
    assert Resumable.of(rows[:0], POSES, STAMPS) is None
    assert Resumable.of(rows, [], []) is None
    assert Resumable.of(rows_of(range(-9, 0)), POSES, STAMPS) is None


@pytest.mark.filterwarnings('error')
def test_rows_that_cannot_be_gaussians_are_passed_over() -> None:
    """Unknown keyframes, epochs out of range, not finite; a scale of 0 is usable."""
    rows = tracked_rows()
    rows['keyframe'][:4] = -1, 3, -(2**31), 2**31 - 1
    rows['id'][4:8] = np.nan, np.inf, 2.0**60, 3
    rows['x'][8], rows['scale_1'][9], rows['rot_3'][10] = np.nan, np.inf, -np.inf
    rows['scale_2'][11] = 0
    resumable = Resumable.of(rows, POSES, STAMPS)
    assert resumable is not None
    np.testing.assert_array_equal(resumable.rows['id'], rows['id'][11:])
    gaussians = resumable.gaussians(Config())
    assert len(gaussians) == len(rows) - 11
    for values in (gaussians.means, gaussians.normals, gaussians.flatness):
        assert np.isfinite(values).all()


def test_of_two_epochs_the_later_one_counts() -> None:
    rows = np.concatenate([tracked_rows(5, 4), tracked_rows(6, 9)])
    resumable = Resumable.of(rows, POSES, STAMPS)
    assert resumable is not None and resumable.epoch == 9 and len(resumable.rows) == 6
