# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The maps of a mapper node: what begins one, what is refused, what is saved."""

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

from dcgs_ros.core import se3
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.errors import DcgsError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.keyframe import Correction, Keyframe, KeyframePose, PosedFrame
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.io.map_archive import read_map
from dcgs_ros.io.ply import read_ply
from dcgs_ros.nodes.health import Level
from dcgs_ros.nodes.mapping.session import MappingSession
from dcgs_ros.nodes.messages.ids import epoch_of_file, first_epoch, joined_ids, next_epoch
from dcgs_ros.nodes.messages.packet import KeyframePacket

CAMERA = PinholeCamera(48, 36, 42.0, 42.0, 23.5, 17.5)
LARGER = PinholeCamera(64, 48, 56.0, 56.0, 31.5, 23.5)
SMALLEST = PinholeCamera(16, 16, 14.0, 14.0, 7.5, 7.5)
RESTING_STEPS = 7
CONFIG = override(
    Config(), {'threads': 1, 'mapping.final_steps': RESTING_STEPS, 'mapping.trial_visits': 1000}
)
WALL_M = 1.5
FIRST, OTHER = first_epoch(), first_epoch()  # of two trackers, all but certainly


def packet_of(
    index: int, epoch: int = 5, first_id: int | None = None, camera: PinholeCamera = CAMERA
) -> KeyframePacket:
    """Pack a keyframe of a wall, each from another place; epoch 0: a view without Gaussians."""
    T = se3.exp(np.array([0.05 * index, -0.02 * index, 0.0, 0.0, 0.01 * index, 0.0]))
    rays = np.ones((camera.height, camera.width, 3))
    rays[..., :2] = camera.undistortion_map
    directions = rays @ T[:3, :3].T
    depth_m = (WALL_M - T[2, 3]) / directions[..., 2]
    points = T[:3, 3] + depth_m[..., None] * directions
    waves = np.sin(np.array([9.0, 7.0, 11.0]) * (points[..., :1] + 0.5 * points[..., 1:2]))
    color = np.round(127 + 100 * waves).astype(np.uint8)
    stamp_ns = 10**9 + index
    posed = PosedFrame(
        RgbdFrame(stamp_ns, stamp_ns, color, depth_m.astype(np.float32)), T, np.eye(4)
    )
    if epoch:
        means = points[2::5, 2::5].reshape(-1, 3).astype(np.float32)
        first = 1000 * index if first_id is None else first_id
        posed = Keyframe(
            posed.frame, T, np.eye(4), first + np.arange(len(means), dtype=np.int64), means,
            np.tile(np.array([0, 0, -1], np.float32), (len(means), 1)),
        )  # fmt: skip
    return KeyframePacket(epoch, camera, posed, 'optical')


def keyframe_of(packet: KeyframePacket) -> Keyframe:
    assert isinstance(packet.posed, Keyframe)
    return packet.posed


def changed(packet: KeyframePacket, **values: Any) -> KeyframePacket:
    return replace(packet, posed=replace(packet.posed, **values))


def tracked_ids(session: MappingSession) -> set[int]:
    assert session.mapper is not None
    ids = session.mapper.table.ids
    return set(ids[ids >= 0].tolist())


def state(session: MappingSession) -> tuple[Mapper | None, int, set[int], bytes, int]:
    mapper = session.mapper
    planes = mapper.table.splats.planes.tobytes() if mapper is not None else b''
    views = len(mapper.views) if mapper is not None else 0
    return mapper, session.epoch, set(session.stamps), planes, views


@pytest.fixture
def warnings() -> list[str]:
    return []


@pytest.fixture
def session(warnings: list[str]) -> Iterator[MappingSession]:
    session = MappingSession(CONFIG, warnings.append)
    yield session
    session.close()


def test_before_any_keyframe_there_is_nothing_and_nothing_to_do(session: MappingSession) -> None:
    assert session.insert(packet_of(0, epoch=0)) is None
    assert not session.advance()
    assert session.render(0, np.eye(4)) is None
    session.reconfigure(CONFIG)
    session.reset()
    assert session.mapper is None and session.epoch == 0 and not session.stamps


def test_keyframes_and_views_of_a_map_go_into_it(
    session: MappingSession, warnings: list[str]
) -> None:
    packets = [packet_of(0), packet_of(1, epoch=0), packet_of(2)]
    for packet in packets:
        assert session.insert(packet) is not None
    assert session.mapper is not None and len(session.mapper.views) == 3
    assert session.epoch == 5 and session.stamps == {10**9, 10**9 + 1, 10**9 + 2}
    keyframes = [keyframe_of(packet) for packet in packets if packet.carries_gaussians]
    assert tracked_ids(session) == {int(k) for keyframe in keyframes for k in keyframe.ids}
    assert not warnings


@pytest.mark.parametrize('epoch', [0, 5])
def test_a_keyframe_that_is_here_already_changes_nothing(
    session: MappingSession, epoch: int
) -> None:
    """It is sent again when its acknowledgement was late, perhaps with more Gaussians."""
    session.insert(packet_of(0))
    assert session.insert(packet_of(1, epoch)) is not None
    before = state(session)
    assert session.insert(packet_of(1, epoch)) is None
    assert session.insert(packet_of(1, 5, first_id=7000)) is None
    assert state(session) == before and session.refused == 0


def test_a_late_keyframe_brings_what_is_not_here_yet(session: MappingSession) -> None:
    """Beyond the tracker's memory one keyframe brings the Gaussians of two."""
    session.insert(packet_of(0))
    session.insert(packet_of(2))
    late, here = keyframe_of(packet_of(1)), keyframe_of(packet_of(2))
    both = replace(
        late, ids=np.concatenate([late.ids, here.ids]),
        means=np.concatenate([late.means, here.means]),
        normals=np.concatenate([late.normals, here.normals]),
    )  # fmt: skip
    assert session.insert(replace(packet_of(1), posed=both)) is not None
    assert session.mapper is not None
    ids = session.mapper.table.ids
    assert len(np.unique(ids)) == len(ids)
    hosts = dict(zip(ids.tolist(), session.mapper.table.hosts.tolist(), strict=True))
    assert {hosts[k] for k in here.ids.tolist()} == {1}
    assert {hosts[k] for k in late.ids.tolist()} == {2}


def test_another_epoch_begins_another_map_and_says_so(
    session: MappingSession, warnings: list[str]
) -> None:
    session.insert(packet_of(0))
    first = session.mapper
    assert session.insert(packet_of(0, epoch=6, first_id=50)) is not None
    assert session.mapper is not first and session.epoch == 6
    assert tracked_ids(session) == set(keyframe_of(packet_of(0, first_id=50)).ids.tolist())
    assert len(warnings) == 1 and 'new map' in warnings[0]


def test_another_epoch_may_have_another_camera(session: MappingSession) -> None:
    session.insert(packet_of(0))
    assert session.insert(packet_of(1, epoch=6, camera=LARGER)) is not None
    assert session.mapper is not None and session.mapper.camera == LARGER
    shown = session.render(0, np.eye(4))
    assert shown is not None and shown.color.shape == (3, 48, 64)


def held(warnings: list[str], trackers: list[int]) -> MappingSession:
    """Return a session that counts the last number of trackers, with a map of the first."""
    session = MappingSession(CONFIG, warnings.append, lambda: trackers[-1])
    assert session.insert(packet_of(0, FIRST)) is not None
    assert session.insert(packet_of(1, FIRST)) is not None
    return session


def test_while_its_tracker_lives_a_map_is_not_given_up_for_another(warnings: list[str]) -> None:
    trackers = [2]
    session = held(warnings, trackers)
    before = state(session)
    for packet in (packet_of(2, OTHER), view_of(3, OTHER), packet_of(4, OTHER)):
        assert session.insert(packet) is None
    assert state(session) == before and session.foreign == 2 == session.figures()['foreign']
    verdict = session.judge(0)
    assert verdict.level is Level.WARN and 'another tracker speaks' in verdict.message
    assert 'namespace' in verdict.message and not warnings
    assert session.insert(view_of(5, FIRST)) is not None
    trackers.append(1)  # the first one has died
    assert session.insert(packet_of(2, OTHER)) is not None
    assert session.epoch == OTHER and len(warnings) == 1
    session.close()


def test_a_new_map_of_the_same_tracker_replaces_the_old_one(warnings: list[str]) -> None:
    session = held(warnings, [2])
    assert session.insert(packet_of(2, next_epoch(FIRST))) is not None
    assert session.epoch == next_epoch(FIRST) and session.foreign == 0
    session.reset()
    assert session.insert(packet_of(0, OTHER)) is not None  # there is nothing to hold to
    session.close()


def view_of(index: int, epoch: int) -> KeyframePacket:
    return replace(packet_of(index, epoch=0), epoch=epoch)


def test_a_view_of_a_map_that_has_not_begun_is_ignored(session: MappingSession) -> None:
    assert session.insert(view_of(0, FIRST)) is None
    session.insert(packet_of(1, OTHER))
    assert session.insert(view_of(2, next_epoch(OTHER))) is None
    assert session.epoch == OTHER and session.stamps == {10**9 + 1}


def test_each_lack_of_keyframes_has_its_own_line(warnings: list[str]) -> None:
    trackers = [0]
    session = MappingSession(CONFIG, warnings.append, lambda: trackers[-1])
    assert 'no tracker runs in this namespace' in session.judge(0).message
    trackers.append(1)
    assert 'tracking?' in session.judge(0).message
    session.insert(packet_of(0))
    assert session.judge(0).level is Level.OK
    session.insert(nothing_measured(packet_of(1)))
    verdict = session.judge(0)
    assert verdict.level is Level.WARN and warnings == [verdict.message] and verdict.logged
    session.insert(packet_of(1))
    assert session.judge(0).level is Level.OK
    assert 'behind' in session.judge(99).message
    session.close()


def nothing_measured(packet: KeyframePacket) -> KeyframePacket:
    return changed(packet, T_world_cam=np.full((4, 4), np.nan))


UNUSABLE: dict[str, Callable[[KeyframePacket], KeyframePacket]] = {
    'pose': nothing_measured,
    'motion': lambda packet: changed(packet, T_cam_cam_at_depth=np.full((4, 4), np.inf)),
    'size': lambda packet: replace(packet, camera=LARGER, posed=packet_of(3).posed),
    'rows': lambda packet: changed(packet, means=keyframe_of(packet).means[:-1]),
    'twice': lambda packet: changed(packet, ids=np.repeat(keyframe_of(packet).ids[::2], 2)),
}


@pytest.mark.parametrize('fault', UNUSABLE)
@pytest.mark.parametrize('epoch', [5, 6])
def test_what_cannot_be_used_is_counted_warnings_and_costs_nothing(
    session: MappingSession, warnings: list[str], fault: str, epoch: int
) -> None:
    """One of another epoch does not even end the current map."""
    session.insert(packet_of(0))
    before = state(session)
    bad = UNUSABLE[fault](packet_of(2, epoch))
    if fault == 'size' and epoch == 5:
        bad = replace(bad, posed=packet_of(2, camera=LARGER).posed)
    assert session.insert(bad) is None
    assert state(session) == before
    assert session.refused == 1 and len(warnings) == 1 and 'refused' in warnings[0]
    assert session.insert(packet_of(2, epoch)) is not None  # the same one, whole
    assert session.epoch == epoch


def test_a_camera_that_changes_size_within_an_epoch_is_refused_frame_by_frame(
    session: MappingSession, warnings: list[str]
) -> None:
    session.insert(packet_of(0))
    for k, epoch in enumerate((5, 0, 5), start=1):
        assert session.insert(packet_of(k, epoch, camera=LARGER)) is None
    assert session.refused == 3 and '64x48' in warnings[0]
    assert session.insert(packet_of(4)) is not None
    assert session.mapper is not None and len(session.mapper.views) == 2


@pytest.mark.parametrize('camera', [SMALLEST, PinholeCamera(17, 19, 15.0, 15.0, 8.0, 9.0)])
def test_the_smallest_cameras_are_mapped_too(
    session: MappingSession, camera: PinholeCamera
) -> None:
    for k in range(2):
        assert session.insert(packet_of(k, camera=camera)) is not None
    for _ in range(RESTING_STEPS):
        assert session.advance()
    assert session.mapper is not None and np.isfinite(session.mapper.table.planes).all()


def test_a_map_that_had_its_steps_rests_until_something_comes(session: MappingSession) -> None:
    session.insert(packet_of(0))
    for _ in range(2):
        assert [session.advance() for _ in range(RESTING_STEPS + 2)] == [True] * 7 + [False] * 2
        assert session.insert(packet_of(0)) is None and not session.advance()
        session.insert(packet_of(1, epoch=0))


def test_after_a_reset_everything_may_come_again(session: MappingSession) -> None:
    session.insert(packet_of(0))
    session.insert(packet_of(1))
    session.reset()
    assert session.insert(packet_of(2, epoch=0)) is None
    for k in (1, 0):
        assert session.insert(packet_of(k)) is not None
    assert session.mapper is not None and len(session.mapper.views) == 2
    found = session.render(10**9, np.eye(4))
    assert found is not None and np.isfinite(found.color).all()


def test_settings_that_change_hold_for_this_map_and_the_next(session: MappingSession) -> None:
    session.insert(packet_of(0))
    session.reconfigure(override(CONFIG, {'mapping.final_steps': 2}))
    assert [session.advance() for _ in range(4)] == [True, True, False, False]
    session.insert(packet_of(0, epoch=6))
    assert [session.advance() for _ in range(4)] == [True, True, False, False]


@pytest.mark.filterwarnings('error')
def test_a_map_is_saved_whole_and_read_again(session: MappingSession, tmp_path: Path) -> None:
    for k in range(3):
        session.insert(packet_of(k, epoch=5 if k != 1 else 0))
    for _ in range(5):
        session.advance()
    texts = [session.save(tmp_path / 'deep' / 'runs') for _ in range(2)]
    folders = sorted((tmp_path / 'deep' / 'runs').iterdir())
    assert [text.rpartition(' in ')[2] for text in texts] == [str(folder) for folder in folders]
    saved = read_map(folders[1] / 'map.dcgs')
    assert session.mapper is not None
    np.testing.assert_array_equal(saved.ids, session.mapper.table.ids)
    np.testing.assert_array_equal(saved.splats.planes, session.mapper.table.splats.planes)
    np.testing.assert_array_equal(saved.measured, saved.ids >= 0)
    assert [k.stamp_ns for k in saved.keyframes] == [10**9, 10**9 + 1, 10**9 + 2]
    assert len(read_ply(folders[1] / 'map.ply')) == len(saved.ids)
    assert session.insert(packet_of(4)) is not None  # and it goes on


def global_packet(index: int, epoch: int) -> KeyframePacket:
    """Pack a keyframe with the ids that it has between the nodes."""
    packet = packet_of(index, epoch)
    return changed(packet, ids=joined_ids(epoch, keyframe_of(packet).ids))


def saved_file(session: MappingSession, folder: Path) -> Path:
    return Path(session.save(folder).rpartition(' in ')[2]) / 'map.dcgs'


def test_a_saved_map_is_loaded_by_another_mapper_and_extended(
    session: MappingSession, warnings: list[str], tmp_path: Path
) -> None:
    for k in range(3):
        session.insert(global_packet(k, FIRST))
    for _ in range(5):
        session.advance()
    path = saved_file(session, tmp_path)
    before, data = read_map(path), path.read_bytes()
    assert before.ids.max() < 3000 and before.tracker.ids.max() < 3000  # without the epoch
    later = MappingSession(CONFIG, warnings.append)
    text = later.load(path)
    assert text == f'{len(before.ids)} Gaussians, 3 keyframes in {path}'
    assert later.epoch == epoch_of_file(path) and not later.advance()  # nothing new to learn
    assert tracked_ids(later) == set(joined_ids(later.epoch, before.tracker.ids).tolist())
    assert later.insert(global_packet(1, later.epoch)) is None  # it is here
    assert later.insert(global_packet(3, later.epoch)) is not None and later.advance()
    after = read_map(saved_file(later, tmp_path))
    assert after.sessions[0] == before.sessions[0]
    assert [(s.keyframes, s.views) for s in after.sessions] == [(3, 3), (1, 1)]
    assert set(before.tracker.ids.tolist()) < set(after.tracker.ids.tolist())
    assert path.read_bytes() == data and not warnings
    later.close()


def test_saved_loaded_and_saved_again_is_the_same_file(
    session: MappingSession, tmp_path: Path
) -> None:
    for k in range(3):
        session.insert(global_packet(k, FIRST))
    for _ in range(9):
        session.advance()
    path = saved_file(session, tmp_path)
    session.load(path)
    assert saved_file(session, tmp_path).read_bytes() == path.read_bytes()


def test_where_it_only_localises_the_map_stays(
    session: MappingSession, warnings: list[str], tmp_path: Path
) -> None:
    session.insert(global_packet(0, FIRST))
    path = saved_file(session, tmp_path)
    still = MappingSession(CONFIG, warnings.append, localize_only=True)
    still.load(path)
    for epoch in (still.epoch, OTHER):
        assert still.insert(global_packet(1, epoch)) is None
    assert not still.advance() and not warnings
    assert saved_file(still, tmp_path).read_bytes() == path.read_bytes()
    still.close()


def test_keyframes_of_another_camera_do_not_extend_a_map(
    session: MappingSession, warnings: list[str]
) -> None:
    session.insert(packet_of(0))
    other = replace(CAMERA, fx=43.0)
    assert session.insert(packet_of(1, camera=other)) is None
    assert 'it is of a camera of 48x36, fx 43, the map of one of 48x36, fx 42' in warnings[0]
    assert session.mapper is not None and len(session.mapper.views) == 1


def test_a_damaged_file_leaves_the_map(session: MappingSession, tmp_path: Path) -> None:
    session.insert(packet_of(0))
    before = state(session)
    (tmp_path / 'a.dcgs').write_bytes(b'no map')
    for path in (tmp_path / 'a.dcgs', tmp_path / 'nowhere.dcgs', tmp_path):
        with pytest.raises(DcgsError, match=str(path)):
            session.load(path)
    assert state(session) == before


def test_autosaving_replaces_the_last_one_or_keeps_it(
    session: MappingSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / 'deep' / 'autosave.dcgs'
    with pytest.raises(DcgsError, match='no map'):
        session.autosave(path.parent)
    for k in range(2):
        session.insert(packet_of(k))
        session.autosave(path.parent)
        assert len(read_map(path).keyframes) == k + 1
    data = path.read_bytes()
    monkeypatch.setattr(os, 'replace', fails)
    session.insert(packet_of(2))
    with pytest.raises(DcgsError, match='No space left'):
        session.autosave(path.parent)
    assert path.read_bytes() == data and list(path.parent.iterdir()) == [path]


def fails(*_: object) -> None:
    raise OSError(28, 'No space left on device')


def test_without_a_map_there_is_nothing_to_save(session: MappingSession, tmp_path: Path) -> None:
    with pytest.raises(DcgsError, match='no map'):
        session.save(tmp_path / 'runs')
    assert not (tmp_path / 'runs').exists()


def test_a_folder_that_cannot_be_written_is_refused_in_words(
    session: MappingSession, tmp_path: Path
) -> None:
    session.insert(packet_of(0))
    before = state(session)
    file = tmp_path / 'file'
    file.write_text('')
    places = [file, file / 'below', Path('/proc/nothing'), tmp_path / ('x' * 300)]
    if os.getuid() != 0:  # root may write anywhere
        locked = tmp_path / 'locked'
        locked.mkdir(mode=0o500)
        places.append(locked)
    for folder in places:
        with pytest.raises(DcgsError, match=str(folder)):
            session.save(folder)
    assert state(session) == before


def test_a_full_disk_is_an_error_in_words(
    session: MappingSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session.insert(packet_of(0))

    def full(*_: object, **__: object) -> int:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'replace', full)
    monkeypatch.setattr(Path, 'replace', full)
    with pytest.raises(DcgsError, match='No space left'):
        session.save(tmp_path)


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
    session = MappingSession(CONFIG, lambda _: None)
    session.insert(packet_of(0))
    n = len(means)
    mean_rows, normal_rows = (np.array(rows, np.float32) for rows in (means, normals[:n]))
    ids = 5000 + np.arange(n, dtype=np.int64)
    bad = changed(
        packet_of(1), ids=ids, means=mean_rows, normals=normal_rows,
        T_world_cam=se3.exp(np.array(off)),
    )  # fmt: skip
    assert session.insert(bad) is not None
    for _ in range(3):
        session.advance()
    assert session.mapper is not None
    assert np.isfinite(loss_of(session.mapper))
    text = session.save(tmp_path)
    saved = read_map(Path(text.rpartition(' in ')[2]) / 'map.dcgs')
    own = set(keyframe_of(packet_of(0)).ids.tolist())
    assert own <= set(saved.ids[saved.measured].tolist())


def loss_of(mapper: Mapper) -> float:
    return mapper.step(rate=0.0)


def test_the_map_is_that_of_the_wall(session: MappingSession) -> None:
    """After all steps a rendered view is what the camera saw."""
    session.reconfigure(override(CONFIG, {'mapping.final_steps': 200}))
    for k in range(3):
        session.insert(packet_of(k))
    while session.advance():
        pass
    seen = packet_of(1).posed
    shown = session.render(seen.frame.stamp_ns, seen.T_world_cam)
    assert shown is not None
    difference = shown.color - np.moveaxis(seen.frame.color, -1, 0) / 255.0
    assert -10 * np.log10(np.mean(difference**2)) > 25.0


ASIDE = se3.exp(np.array([0.3, 0.1, 0.0, 0.0, 0.0, 0.2]))


def corrected(*packets: KeyframePacket, revision: int = 1) -> Correction:
    """Move all keyframes but the first."""
    stamps = np.array([packet.stamp_ns for packet in packets], np.int64)
    poses = np.array([packet.posed.T_world_cam for packet in packets])
    poses[1:] = ASIDE @ poses[1:]
    n = len(packets)
    return Correction(revision, stamps, poses, np.zeros((n, 6, 6)), np.zeros(n, np.int32))


def poses_of(session: MappingSession) -> dict[int, Any]:
    assert session.mapper is not None
    return {view.stamp_ns: view.T_tracked for view in session.mapper.views}


@pytest.mark.parametrize('first', ['keyframes', 'correction', 'half'])
def test_a_correction_holds_whenever_it_comes(session: MappingSession, first: str) -> None:
    """For keyframes from before it that come after it, for late joiners and after a reset."""
    packets = [packet_of(k, FIRST) for k in range(3)]
    correction = corrected(*packets)
    known = {'keyframes': 3, 'half': 2, 'correction': 0}[first]
    for packet in packets[:known]:
        session.insert(packet)
    assert session.correct(correction, FIRST) == (known > 0)
    for packet in packets[known:]:
        session.insert(packet)
    view = packet_of(3, 0)
    reference = KeyframePose(packets[2].stamp_ns, packets[2].posed.T_world_cam)
    session.insert(changed(view, reference=reference))  # tracked before the correction
    expected = dict(zip(correction.stamps_ns.tolist(), correction.T_world_cam, strict=True))
    expected[view.stamp_ns] = ASIDE @ view.posed.T_world_cam
    for again in range(2):
        for stamp, T in poses_of(session).items():
            np.testing.assert_allclose(T, expected[stamp], atol=1e-9)
        session.reset()
        if again == 0:
            for packet in packets:
                session.insert(packet)


def test_a_correction_counts_once_and_wakes_a_map_that_rests(session: MappingSession) -> None:
    packets = [packet_of(k, FIRST) for k in range(2)]
    for packet in packets:
        session.insert(packet)
    while session.advance():
        pass
    assert session.correct(corrected(*packets), FIRST)
    steps = 0
    while session.advance():
        steps += 1
    assert steps == RESTING_STEPS
    before = state(session)
    assert not session.correct(corrected(*packets, revision=2), FIRST)
    assert state(session) == before and not session.advance()
    assert session.figures()['revision'] == 2


def test_a_keyframe_that_overtook_a_correction_stays(session: MappingSession) -> None:
    """Made after it, it is in its world already, and the correction does not name it."""
    packets = [packet_of(k, FIRST) for k in range(2)]
    for packet in packets:
        session.insert(packet)
    early = packet_of(2, FIRST)
    session.insert(early)
    session.correct(corrected(*packets), FIRST)
    np.testing.assert_allclose(
        poses_of(session)[early.stamp_ns], early.posed.T_world_cam, atol=1e-12
    )


def test_the_poses_of_another_trackers_map_move_nothing(session: MappingSession) -> None:
    packets = [packet_of(k, FIRST) for k in range(2)]
    for packet in packets:
        session.insert(packet)
    before = state(session)
    for k in range(40):
        assert not session.correct(corrected(*packets), next_epoch(FIRST) + k)
    assert state(session) == before and len(session._corrections) < 10


@pytest.mark.parametrize('corrected_first', [False, True])
def test_submaps_of_keyframes_are_known_saved_and_joined(
    session: MappingSession, tmp_path: Path, corrected_first: bool
) -> None:
    packets = [packet_of(k, FIRST) for k in range(3)]
    packets[1:] = [changed(packet, submap=1) for packet in packets[1:]]
    if corrected_first:
        joined = replace(corrected(*packets[:2]), submaps=np.zeros(2, np.int32))
        session.correct(joined, FIRST)
    for packet in packets:
        session.insert(packet)
    session.insert(packet_of(3, 0))  # a view that tells no keyframe
    expected = [0, 0, 1, 1] if corrected_first else [0, 1, 1, 1]
    assert session.mapper is not None and session.mapper.submaps == expected
    path = Path(session.save(tmp_path).rpartition(' in ')[2]) / 'map.dcgs'
    assert read_map(path).tracker.submaps.tolist() == expected[:3]
    again = MappingSession(CONFIG, print)
    again.load(path)
    assert again.mapper is not None and again.mapper.submaps == expected
    again.close()


def test_a_reset_empties_the_map_unless_it_only_localises(
    session: MappingSession, tmp_path: Path
) -> None:
    session.insert(packet_of(0))
    path = Path(session.save(tmp_path).rpartition(' in ')[2]) / 'map.dcgs'
    fixed = MappingSession(CONFIG, print, localize_only=True)
    for one, stays in ((session, False), (fixed, True)):
        one.load(path)
        before = one.mapper
        assert ('stays as it was loaded' in one.reset()) == stays
        assert one.mapper is (before if stays else None) and bool(one.stamps) == stays
        one.load(path)
        assert one.mapper is not before and one.stamps == {10**9}
    fixed.close()
