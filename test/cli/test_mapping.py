# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A run that maps: its files agree, and are written even if a part fails or is interrupted."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from running import (  # type: ignore[import-not-found]
    MAPS,
    SMALL_ADDRESS,
    SMALL_CAMERA,
    SMALL_FRAMES,
    SMALL_ROOM,
    TRACKS,
    Run,
    run_into,
)

from dcgs_ros.cli.run import session
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.errors import FrameError
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.camera_presets import PRESETS
from dcgs_ros.datasets.synthetic.sensors.catalogue import SENSORS
from dcgs_ros.io.config_file import apply_file
from dcgs_ros.io.map_archive import SavedMap, read_map
from dcgs_ros.io.ply import read_ply
from dcgs_ros.io.trajectory import read_tum

RENDERING = {
    'psnr_db', 'ssim', 'lpips', 'views', 'protocol', 'interpolated', 'depth_masked',
    'mean_transmittance', 'keyframes', 'others',
}  # fmt: skip
PRINTED_M = 1e-9  # decimals of a trajectory file
FLOAT32 = 1e-5  # relative
FULL_ROOM = ('synthetic:room?frames=8', '--quality', 'draft', '--set', 'mapping.final_steps=20')
WARM_UP = 8  # frames that are tracked before the first one: by the tracker's, and the back end's
STEPS = 10_000  # more than any test waits for
PATIENCE_S = 120.0  # only a failure takes so long

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('small_images')]


@pytest.fixture(scope='module')
def saved(mapped: Run) -> SavedMap:
    return read_map(mapped.folder / 'map.dcgs')


def test_a_run_maps_by_default(mapped: Run) -> None:
    assert mapped.status == 0, mapped.err
    assert mapped.files() == TRACKS | MAPS
    assert mapped.report()['lost'] == 0


def test_the_report_holds_mapping_and_rendering(mapped: Run) -> None:
    report = mapped.report()
    assert set(report['mapping']) == {'gaussians', 'iterations', 'iterations_per_s'}
    assert set(report['rendering']) == RENDERING
    assert report['rendering']['protocol'] == 'full'
    assert report['rendering']['views'] == SMALL_FRAMES / 2
    for name in ('interpolated', 'depth_masked'):
        assert set(report['rendering'][name]) == {'psnr_db', 'ssim', 'lpips'}
    groups = [report['rendering'][name]['views'] for name in ('keyframes', 'others')]
    assert sum(groups) == SMALL_FRAMES / 2
    assert min(groups) > 0


def test_the_mapper_took_the_configured_steps(mapped: Run) -> None:
    # From the second frame on two steps a frame, and twelve at the end.
    assert mapped.report()['mapping']['iterations'] == 2 * (SMALL_FRAMES - 1) + 12


def test_both_files_of_the_map_are_one_map(mapped: Run, saved: SavedMap) -> None:
    splats = read_ply(mapped.folder / 'map.ply')
    np.testing.assert_array_equal(splats.planes, saved.splats.planes)
    assert len(splats) == mapped.report()['mapping']['gaussians']
    assert saved.config == apply_file(Config(), mapped.folder / 'config.yaml')
    assert saved.camera == SMALL_CAMERA


def test_keyframes_are_frames_of_the_trajectory_where_they_were_tracked(
    mapped: Run, saved: SavedMap
) -> None:
    estimate = read_tum(mapped.folder / 'trajectory.tum')
    rows = np.searchsorted(estimate.stamps_ns, [k.stamp_ns for k in saved.keyframes])
    assert rows[0] == 0
    assert len(rows) >= 3
    for row, keyframe in zip(rows, saved.keyframes, strict=True):
        assert estimate.stamps_ns[row] == keyframe.stamp_ns
        np.testing.assert_allclose(keyframe.T_tracked, estimate.T_world_cam[row], atol=PRINTED_M)
        for data, kind in ((keyframe.color_jpeg, np.uint8), (keyframe.depth_png, np.uint16)):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            assert image.dtype == kind
            assert image.shape[:2] == (SMALL_CAMERA.height, SMALL_CAMERA.width)


def test_what_the_tracker_measured_is_saved_by_id(saved: SavedMap) -> None:
    tracked = saved.ids >= 0
    assert tracked.any()
    assert not tracked.all()
    centres = np.array([keyframe.T_tracked[:3, 3] for keyframe in saved.keyframes])
    distances = np.linalg.norm(saved.viewpoints[tracked, None] - centres, axis=2)
    assert distances.min(axis=1).max() < FLOAT32  # each was last seen from a keyframe
    xx, xy, xz, yy, yz, zz = saved.track_covariances[tracked].astype(np.float64).T
    Sigma_t = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)
    assert np.linalg.eigvalsh(Sigma_t).min() > 0
    # One axis is the ray.
    rays = saved.splats.means.T[tracked] - saved.viewpoints[tracked]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    turned = np.einsum('ijk,ik->ij', Sigma_t, rays)
    along = np.sum(turned * rays, axis=1, keepdims=True)
    assert np.median(np.linalg.norm(turned - along * rays, axis=1) / along[:, 0]) < 0.01
    assert np.isnan(saved.viewpoints[~tracked]).all()


def test_the_table_shows_the_map(mapped: Run) -> None:
    report = mapped.report()
    assert f'{report["mapping"]["iterations"]} steps' in mapped.out
    assert f'PSNR {report["rendering"]["psnr_db"]:.2f} dB' in mapped.out
    assert 'interpolated' in mapped.out
    assert 'no LPIPS' in mapped.out
    assert str(mapped.folder / 'map.dcgs') in mapped.out
    assert '\r' not in mapped.err


def test_two_runs_and_any_number_of_threads_write_the_same_bytes(
    mapped: Run, tmp_path: Path
) -> None:
    for threads in (1, 2):
        again = run_into(tmp_path / str(threads), *SMALL_ROOM, f'threads={threads}')
        for name in ('trajectory.tum', 'map.ply'):
            assert (again.folder / name).read_bytes() == (mapped.folder / name).read_bytes()
        for key, value in again.report()['rendering'].items():
            assert value == mapped.report()['rendering'][key]


@pytest.mark.slow
def test_full_images_and_any_number_of_threads_give_the_same_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, kind in SENSORS.items():
        monkeypatch.setitem(SENSORS, name, replace(kind, camera=PRESETS['fr3'].camera))
    folders = [
        run_into(tmp_path / str(k), *FULL_ROOM, f'threads={threads}', '--render-every', '0').folder
        for k, threads in enumerate((1, 2, 2))
    ]
    for folder in folders[1:]:
        for name in ('trajectory.tum', 'map.ply'):
            assert (folder / name).read_bytes() == (folders[0] / name).read_bytes()


def test_without_rendering_the_source_is_not_read_again(tmp_path: Path) -> None:
    done = run_into(tmp_path / 'run', *SMALL_ROOM, '--render-every', '0')
    assert done.files() == TRACKS | MAPS - {'views.png'}
    assert done.report()['rendering'] is None
    assert 'rendering     not evaluated' in done.out


@pytest.mark.parametrize(
    ('words', 'steps'),
    [
        ([], (Config().mapping.steps_per_frame, Config().mapping.final_steps)),
        (
            ['--quality', 'default'],
            (Config().mapping.steps_per_frame, Config().mapping.final_steps),
        ),
        (['--quality', 'draft'], (1, 100)),
        (['--quality', 'high'], (4, 6000)),
        (['--quality', 'draft', '--set', 'mapping.final_steps=7'], (1, 7)),
        (['--quality', 'high', '--config'], (2, 6000)),
    ],
)
def test_quality_is_the_mappers_steps_below_file_and_settings(
    tmp_path: Path, words: list[str], steps: tuple[float, int]
) -> None:
    if words[-1:] == ['--config']:
        (tmp_path / 'settings.yaml').write_text('mapping: {steps_per_frame: 2}')
        words = [*words, str(tmp_path / 'settings.yaml')]
    done = run_into(tmp_path / 'run', SMALL_ADDRESS, '--max-frames', '1', '--no-mapping', *words)
    mapping = apply_file(Config(), done.folder / 'config.yaml').mapping
    assert (mapping.steps_per_frame, mapping.final_steps) == steps


def test_one_frame_makes_a_map(tmp_path: Path) -> None:
    done = run_into(tmp_path / 'run', *SMALL_ROOM, '--max-frames=1')
    assert done.status == 0, done.err
    assert done.files() == TRACKS | MAPS
    rendering = done.report()['rendering']
    assert (rendering['keyframes']['views'], rendering['others']['views']) == (1, 0)


def test_if_all_frames_are_lost_there_is_no_map(tmp_path: Path) -> None:
    done = run_into(tmp_path / 'run', *SMALL_ROOM, 'registration.min_pairs=100000')
    assert done.status == 2
    assert done.report()['lost'] == SMALL_FRAMES
    assert done.files() == TRACKS - {'trajectory.png'}
    assert done.report()['rendering'] is None


def interrupting(method: Callable[..., Any], call: int) -> Callable[..., Any]:
    """Return the method, sending SIGINT in its `call`-th call."""
    calls = 0

    def counted(*arguments: Any, **keywords: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call:
            os.kill(os.getpid(), signal.SIGINT)
        return method(*arguments, **keywords)

    return counted


def test_ctrl_c_while_refining_ends_that_and_writes_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Mapper, 'step', interrupting(Mapper.step, 60))
    done = run_into(tmp_path / 'run', *SMALL_ROOM, f'mapping.final_steps={STEPS}')
    assert done.status == 130
    assert done.files() == TRACKS | MAPS
    report = done.report()
    assert report['interrupted'] is True
    assert report['frames'] == SMALL_FRAMES
    assert 30 < report['mapping']['iterations'] < STEPS
    assert report['rendering']['views'] == SMALL_FRAMES / 2
    assert 'interrupted' in done.out


@pytest.mark.parametrize('online', [False, True])
def test_ctrl_c_while_tracking_skips_the_refinement_and_writes_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, online: bool
) -> None:
    words = [*SMALL_ROOM, f'mapping.final_steps={STEPS}', *['--online'] * online]
    monkeypatch.setattr(Tracker, 'track', interrupting(Tracker.track, WARM_UP + 5))
    done = run_into(tmp_path / 'run', *words)
    assert done.status == 130
    assert done.files() == TRACKS | MAPS
    report = done.report()
    assert report['interrupted'] is True
    assert report['frames'] - report['dropped'] == 5
    assert report['mapping']['iterations'] < STEPS
    assert 'mapper' not in {thread.name for thread in threading.enumerate()}


class BrokenError(Exception):
    """An unexpected error: not a `DcgsError`."""


@pytest.mark.parametrize('online', [False, True])
def test_no_pose_is_lost_when_the_mapper_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, online: bool
) -> None:
    insert = Mapper.insert

    def third(self: Mapper, keyframe: Any) -> None:
        if len(self.views) == 2 and self.config.mapping.view_interval > 1:  # not the warm-up's
            raise BrokenError
        insert(self, keyframe)

    monkeypatch.setattr(Mapper, 'insert', third)
    with pytest.raises(BrokenError):
        # Every second frame is a view, so that enough arrive even if a busy machine drops some.
        words = [*SMALL_ROOM, '--set', 'mapping.view_interval=2']
        run_into(tmp_path / 'run', *words, *['--online'] * online)
    done = Run(tmp_path / 'run', 1, '', '')
    assert done.files() >= TRACKS | {'map.ply', 'map.dcgs'}
    assert len(read_map(done.folder / 'map.dcgs').keyframes) == 2
    assert len(read_tum(done.folder / 'trajectory.tum')) >= 4
    assert done.report()['interrupted'] is True
    assert 'mapper' not in {thread.name for thread in threading.enumerate()}


@pytest.mark.parametrize(
    ('part', 'missing'),
    [
        ('write_ply', {'map.ply', 'views.png'}),
        ('write_map', {'map.dcgs', 'views.png'}),
        ('write_plot', {'trajectory.png', 'views.png'}),
        ('score_map', {'views.png'}),
        ('write_contact_sheet', {'views.png'}),
    ],
)
def test_no_other_file_is_lost_when_a_part_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str, missing: set[str]
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, 'No space left', 'x')

    monkeypatch.setattr(session, part, full)
    done = run_into(tmp_path / 'run', *SMALL_ROOM, '--max-frames', '4')
    assert done.status == 2
    assert done.err.splitlines()[-1] == 'dcgs: x: No space left'
    assert done.files() == (TRACKS | MAPS) - missing
    assert (done.report()['rendering'] is None) == (part != 'write_contact_sheet')
    assert str(done.folder) in done.out


def test_online_frames_come_at_their_own_pace(tmp_path: Path) -> None:
    done = run_into(tmp_path / 'run', *SMALL_ROOM, '--online')
    assert done.status == 0, done.err
    assert done.files() == TRACKS | MAPS
    report, stamps_ns = done.report(), read_tum(done.folder / 'trajectory.tum').stamps_ns
    assert report['wall_s'] >= 1e-9 * (stamps_ns[-1] - stamps_ns[0])
    assert report['realtime_factor'] <= 1.0
    assert report['skipped'] == report['dropped']
    assert report['frames'] == SMALL_FRAMES
    assert 'mapper' not in {thread.name for thread in threading.enumerate()}


def test_online_without_a_mapper_paces_the_tracker_alone(tmp_path: Path) -> None:
    done = run_into(tmp_path / 'run', *SMALL_ROOM, '--online', '--no-mapping')
    assert done.files() == TRACKS
    assert done.report()['realtime_factor'] <= 1.0
    assert done.report()['mapping']['iterations_per_s'] == 0.0


def test_frames_that_come_while_the_tracker_is_busy_are_dropped_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track, calls = Tracker.track, 0

    def slow(self: Tracker, frame: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == WARM_UP + 1:
            for thread in threading.enumerate():
                if thread.name == 'prefetch':  # it ends with the last frame
                    thread.join(PATIENCE_S)
        return track(self, frame)

    monkeypatch.setattr(Tracker, 'track', slow)
    done = run_into(tmp_path / 'run', *SMALL_ROOM, '--online', '--no-mapping')
    report = done.report()
    assert report['dropped'] >= SMALL_FRAMES - 2  # all but one of the first and the last
    assert report['skipped'] == report['dropped']
    reasons = [row['reason'] for row in done.frames() if row['state'] == 'skipped']
    assert len(reasons) == report['dropped']
    assert all('a newer frame came' in reason for reason in reasons)
    assert f'{report["dropped"]} dropped' in done.out


def test_a_frame_error_of_the_mapper_fails_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    insert = Mapper.insert

    def odd(self: Mapper, keyframe: Any) -> None:
        if len(self.views) == 1 and self.config.mapping.view_interval > 1:
            raise FrameError('odd')
        insert(self, keyframe)

    monkeypatch.setattr(Mapper, 'insert', odd)
    done = run_into(tmp_path / 'run', *SMALL_ROOM)
    assert done.status == 2
    assert done.err.splitlines()[-1] == 'dcgs: odd'
    assert done.files() >= {'trajectory.tum', 'report.json', 'map.dcgs'}
