# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A run that begins in a saved map extends it or leaves it as it is; `dcgs info` describes it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from running import (  # type: ignore[import-not-found]
    MAPS,
    SMALL_ADDRESS,
    SMALL_ROOM,
    TRACKS,
    Run,
    run_into,
)

from dcgs_ros.cli.main import main
from dcgs_ros.cli.run import session
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.synthetic.source import SyntheticSource
from dcgs_ros.io.map_archive import MapFileError, SavedMap, read_map
from dcgs_ros.io.saved_tracker import SavedTracker
from dcgs_ros.io.trajectory import read_tum

SAME_PLACE_M = 0.02

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('small_images')]


@pytest.fixture(scope='module')
def first(mapped: Run) -> SavedMap:
    return read_map(mapped.folder / 'map.dcgs')


def test_a_second_session_extends_the_map_and_leaves_the_file(
    mapped: Run, first: SavedMap, tmp_path: Path
) -> None:
    before = (mapped.folder / 'map.dcgs').read_bytes()
    again = run_into(
        tmp_path / 'again', *SMALL_ROOM, '--map', str(mapped.folder / 'map.dcgs'),
        '--set', 'keyframes.translation_m=0.02', 'keyframes.min_interval_s=0',
    )  # fmt: skip
    assert again.status == 0, again.err
    assert again.files() == TRACKS | MAPS
    assert (mapped.folder / 'map.dcgs').read_bytes() == before
    both = read_map(again.folder / 'map.dcgs')
    assert both.sessions[0] == first.sessions[0] and len(both.sessions) == 2
    old = len(first.tracker.poses)
    assert len(both.tracker.poses) == old + both.sessions[1].keyframes > old
    np.testing.assert_array_equal(both.tracker.poses[:old], first.tracker.poses)
    fresh = np.setdiff1d(both.tracker.ids, first.tracker.ids)
    assert len(fresh) == 0 or fresh.min() >= first.tracker.next_id
    numbers = [view.keyframe for view in both.keyframes if view.keyframe >= 0]
    assert numbers == list(range(len(both.tracker.poses)))
    for ours, theirs in zip(both.keyframes, first.keyframes, strict=False):
        assert ours.color_jpeg == theirs.color_jpeg and ours.keyframe == theirs.keyframe
        np.testing.assert_array_equal(ours.T_tracked, theirs.T_tracked)


def test_poses_of_the_second_session_are_in_the_world_of_the_first(
    mapped: Run, tmp_path: Path
) -> None:
    again = run_into(
        tmp_path / 'there', SMALL_ADDRESS, '--map', str(mapped.folder / 'map.dcgs'), '--localize'
    )
    assert again.status == 0, again.err
    assert again.files() == TRACKS - {'trajectory_optimized.tum'}  # no map, no back end
    assert 'localising in' in again.err and '1 sessions' in again.err
    one, other = (read_tum(run.folder / 'trajectory.tum') for run in (mapped, again))
    common = np.isin(one.stamps_ns, other.stamps_ns)
    assert len(other) >= 5
    apart = np.linalg.norm(one.T_world_cam[common, :3, 3] - other.T_world_cam[:, :3, 3], axis=1)
    assert apart.max() < SAME_PLACE_M
    assert again.report()['keyframes'] == 0


def test_localising_changes_nothing_in_the_map(first: SavedMap) -> None:
    """Where a mapping tracker makes keyframes, to the byte."""
    often = {'keyframes.translation_m': 0.01, 'keyframes.min_interval_s': 0.0}
    source = SyntheticSource.from_address(SMALL_ADDRESS)
    made = {}
    for localize_only in (False, True):
        tracker = Tracker(source.camera, override(first.config, often))
        first.tracker.resume(tracker, first.camera)
        tracker.localize_only = localize_only
        results = [tracker.track(frame) for frame in source]
        assert sum(result.state.value == 'ok' for result in results) >= 1
        made[localize_only] = SavedTracker.of(tracker), [r.keyframe for r in results]
    assert any(made[False][1]) and not any(made[True][1])
    assert made[True][0].is_same_map(first.tracker)
    assert not made[False][0].is_same_map(first.tracker)


@pytest.mark.parametrize('localize_only', [False, True])
def test_only_who_maps_begins_a_sub_map_in_an_unknown_place(
    first: SavedMap, localize_only: bool
) -> None:
    source = SyntheticSource.from_address('synthetic:desk?frames=12')
    config = override(replace(first.config, sensor=source.sensor), {'keyframes.new_submap_s': 0.2})
    tracker = Tracker(source.camera, config)
    first.tracker.resume(tracker, first.camera)
    tracker.localize_only = localize_only
    for frame in source:
        tracker.track(frame)
    assert (tracker.keyframes > len(first.tracker.poses)) != localize_only
    assert tracker.searching == localize_only


def test_a_session_that_fails_leaves_the_first_map(
    mapped: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (mapped.folder / 'map.dcgs').read_bytes()

    def fail(*_: object) -> None:
        raise MapFileError('the disk is gone')

    monkeypatch.setattr(session, 'write_map', fail)
    words = (*SMALL_ROOM, '--map', str(mapped.folder / 'map.dcgs'))
    failed = run_into(tmp_path / 'fails', *words)
    assert failed.status == 2 and 'the disk is gone' in failed.err
    assert 'map.dcgs' not in failed.files()
    assert (mapped.folder / 'map.dcgs').read_bytes() == before


REFUSED = {
    'no map': (['--localize'], '--localize: in which map?'),
    'not there': (['--map', 'nowhere.dcgs'], 'nowhere.dcgs: cannot be read: No such file'),
    'another camera': (
        ['--map', 'MAP', '--camera', '131,131,80,60'],
        'the map is of another camera: 160x120, fx 131.25 .*, not 160x120, fx 131 .*; it cannot '
        'be extended, but the camera can be localised in it',
    ),
}


@pytest.mark.parametrize('case', REFUSED)
def test_what_cannot_be_is_said_before_anything_is_done(
    mapped: Run, tmp_path: Path, case: str
) -> None:
    words, reason = REFUSED[case]
    words = [str(mapped.folder / 'map.dcgs') if word == 'MAP' else word for word in words]
    folder = recorded(tmp_path)
    done = run_into(tmp_path / 'out', folder, *words)
    assert done.status == 2
    assert re.search(reason, done.err), done.err
    assert not (tmp_path / 'out').exists()


def recorded(tmp_path: Path) -> str:
    """Write the sequence as a TUM folder, whose camera can be given."""
    assert main(['convert', SMALL_ADDRESS, str(tmp_path / 'room.tum'), '--format', 'tum']) == 0
    return str(tmp_path / 'room.tum')


def test_another_camera_is_localised_and_that_is_said(mapped: Run, tmp_path: Path) -> None:
    done = run_into(
        tmp_path / 'other', recorded(tmp_path), '--camera', '131,131,79.5,59.5',
        '--map', str(mapped.folder / 'map.dcgs'), '--localize',
    )  # fmt: skip
    assert done.status == 0, done.err
    assert 'the map was made with another camera, 160x120, fx 131.25; the tracker do' in done.err


def test_info_says_what_is_in_a_map(
    mapped: Run, first: SavedMap, capsys: pytest.CaptureFixture[str]
) -> None:
    path = mapped.folder / 'map.dcgs'
    assert main(['info', str(path)]) == 0
    out = capsys.readouterr().out
    own = int((first.ids < 0).sum())
    box = np.ptp(first.tracker.means, axis=0)
    for text in (
        f'{1e-6 * path.stat().st_size:.1f} MB', 'version 3', 'digest     ok',
        f'{len(first.ids)}: {len(first.ids) - own} of the tracker, {own} added',
        f'{len(first.tracker.ids)} Gaussians, {len(first.tracker.poses)} keyframes',
        f'{box[0]:.1f} x {box[1]:.1f} x {box[2]:.1f} m', 'sub-maps   1',
        f'session 1  {SMALL_ADDRESS}', '160x120; fx 131.25', 'sigma(z) =', 'without a date',
    ):  # fmt: skip
        assert text in out, (text, out)


def test_info_refuses_what_is_damaged(
    mapped: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray((mapped.folder / 'map.dcgs').read_bytes())
    data[-100] ^= 1  # in the directory
    (tmp_path / 'a.dcgs').write_bytes(data)
    assert main(['info', str(tmp_path / 'a.dcgs')]) == 2
    assert 'a.dcgs: is damaged: its digest is not that' in capsys.readouterr().err
    assert main(['info', str(mapped.folder / 'map.dcgs'), '--camera', 'fr1']) == 2
    assert 'the options are for sequences' in capsys.readouterr().err
