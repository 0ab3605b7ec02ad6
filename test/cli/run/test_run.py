# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A run writes its results, the same each time, even if it fails or is interrupted."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from running import (  # type: ignore[import-not-found]
    TRACKS,
    WALL,
    Run,
    held_still,
    run_into,
)

from dcgs_ros import __version__
from dcgs_ros.cli import run
from dcgs_ros.cli.frames_file import COLUMNS
from dcgs_ros.cli.main import main
from dcgs_ros.cli.run import session
from dcgs_ros.core.camera import PinholeCamera
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.errors import FrameError
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.sensor import SensorNoise
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import BadFrame
from dcgs_ros.io.config_file import apply_file
from dcgs_ros.io.trajectory import format_stamp_ns, read_tum, write_tum

Writer = Callable[..., Path]
Action = Callable[[], BadFrame | NDArray[np.float32] | None]

ROOT = Path(__file__).resolve().parents[3]
FRAMES = 32  # a little more than a second, the interval of RPE
ROOM = f'synthetic:room?frames={FRAMES}'
SMALL = '60,61,31.5,23.5'  # intrinsics of the 64x48 images of `tum_folder`
CONTRACT = {
    'source': None,
    'ablation': None,
    'frames': None,
    'tracked': None,
    'lost': None,
    'keyframes': None,
    'tracking': {'fps_mean', 'ms_median', 'ms_p95', 'ms_p99'},
    'ate': {'rmse_cm', 'mean_cm', 'median_cm', 'max_cm', 'coverage'},
    'rpe_1s': {'trans_rmse_cm', 'rot_rmse_deg'},
    'states': {'ok', 'degenerate', 'lost', 'relocalised'},
    'nees': {
        'median',
        'mean',
        'mean_bounds_95',
        'translation_median',
        'rotation_median',
        'coverage_2sigma_translation',
        'coverage_2sigma_rotation',
        'motions',
        'independent_motions',
    },
    'silent_frames': None,
    'loops': {'closed', 'corrections', 'submaps', 'seconds'},
    'optimized': {'ate', 'rpe_1s'},
    'mapping': {'gaussians', 'iterations', 'iterations_per_s'},
    'rendering': None,
    'timing': {'colour_depth_offset_ms'},
    'observability': {
        'kappa_median',
        'kappa_without_radius_median',
        'kappa_rotation_median',
        'kappa_translation_median',
    },
    'wall_s': None,
    'realtime_factor': None,
    'peak_rss_mb': None,
    'machine': None,
    'version': None,
}
SETTINGS = {'threads': 1, 'cloud.stride_px': 4, 'keyframes.spawn_stride_px': 3}  # of small images
ROOM_ATE_CM = 1.0
PRINTED_M = 1e-9  # decimals of a trajectory file
TIMEOUT_S = 600.0  # of a subprocess that may have to compile


def track_into(folder: Path, *words: str) -> Run:
    """Run without a mapper."""
    done: Run = run_into(folder, *words, '--no-mapping')
    return done


@pytest.fixture(scope='module')
def room(small_images: None, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Run once, with one thread."""
    words = [f'{key}={value}' for key, value in SETTINGS.items()]
    return track_into(tmp_path_factory.mktemp('runs') / 'room', ROOM, '--set', *words)


@pytest.mark.slow
def test_a_run_tracks_the_room_and_writes_its_folder(room: Run) -> None:
    assert room.status == 0, room.err
    assert room.files() == TRACKS
    report = room.report()
    assert (report['frames'], report['tracked'], report['lost']) == (FRAMES, FRAMES, 0)
    assert report['ate']['rmse_cm'] < ROOM_ATE_CM
    assert report['keyframes'] >= 2


def test_the_report_holds_the_contract(room: Run) -> None:
    report = room.report()
    for key, inner in CONTRACT.items():
        assert key in report
        if inner is not None:
            assert set(report[key]) == inner
    assert set(report) - set(CONTRACT) == {
        'skipped', 'dropped', 'interrupted', 'degenerate', 'address', 'camera',
        'frames_s', 'depth_per_metre', 'depth_in_range', 'warnings',
    }  # fmt: skip
    assert (report['source'], report['ablation']) == (ROOM, 'full')
    assert (report['address'], report['camera']) == (ROOM, None)
    assert report['rendering'] is None
    assert report['mapping']['iterations'] == 0
    assert report['mapping']['iterations_per_s'] == 0.0
    assert report['version'] == __version__
    assert report['interrupted'] is False
    assert 50 < report['peak_rss_mb'] < 5000


@pytest.mark.slow
def test_two_runs_with_one_and_two_threads_write_the_same_bytes(room: Run, tmp_path: Path) -> None:
    words = [f'{key}={value}' for key, value in (SETTINGS | {'threads': 2}).items()]
    again = track_into(tmp_path / 'again', ROOM, '--set', *words)
    for name in ('trajectory.tum', 'keyframes.tum'):
        assert (again.folder / name).read_bytes() == (room.folder / name).read_bytes()


def test_every_frame_has_a_line_and_a_pose(room: Run) -> None:
    rows, estimate = room.frames(), read_tum(room.folder / 'trajectory.tum')
    assert tuple(rows[0]) == COLUMNS
    assert [int(row['index']) for row in rows] == list(range(FRAMES))
    assert [row['stamp'] for row in rows] == [format_stamp_ns(s) for s in estimate.stamps_ns]
    keyframes = [row['stamp'] for row in rows if row['keyframe'] == '1']
    assert len(keyframes) == room.report()['keyframes']
    stamps_ns = read_tum(room.folder / 'keyframes.tum').stamps_ns
    assert keyframes == [format_stamp_ns(stamp_ns) for stamp_ns in stamps_ns]
    ms = [float(row['ms']) for row in rows]
    assert room.report()['tracking']['ms_median'] == pytest.approx(np.median(ms), abs=1e-3)
    for row in rows[1:]:  # the first pose is exact by definition
        assert 0 < float(row['sigma_translation_m']) <= float(row['sigma_world_translation_m'])
        assert 0 < float(row['sigma_rotation_rad']) <= float(row['sigma_world_rotation_rad'])
    weakest = [float(rows[-1][name]) for name in COLUMNS if name.startswith('weakest')]
    assert np.linalg.norm(weakest) == pytest.approx(1.0, abs=1e-5)


def test_the_configuration_as_used_reads_back(room: Run) -> None:
    used = override(Config(sensor=open_source(ROOM).sensor), SETTINGS)
    assert apply_file(Config(), room.folder / 'config.yaml') == used


def test_the_table_shows_ate_fps_and_where_the_plot_is(room: Run) -> None:
    report = room.report()
    assert f'{report["ate"]["rmse_cm"]:.2f} cm' in room.out
    assert f'{report["tracking"]["fps_mean"]:.0f} fps' in room.out
    for name in ('trajectory.png', 'trajectory.tum'):
        assert str(room.folder / name) in room.out
    assert 'interrupted' not in room.out


def test_a_log_holds_no_progress_bar(room: Run) -> None:
    assert '\r' not in room.err
    assert room.err.splitlines()[-1] == f'dcgs: tracking {FRAMES} frames of {ROOM}'


def test_evaluate_finds_what_the_report_says(
    room: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = open_source(ROOM).groundtruth
    assert truth is not None
    write_tum(tmp_path / 'truth.tum', truth)
    files = [str(room.folder / 'trajectory.tum'), str(tmp_path / 'truth.tum')]
    assert main(['evaluate', *files, '--json']) == 0
    found, report = json.loads(capsys.readouterr().out), room.report()
    assert (found['poses'], found['matched']) == (FRAMES, FRAMES)
    for part in ('ate', 'rpe_1s'):
        for key, value in report[part].items():
            if key == 'coverage':  # of what a file does not say
                continue
            assert found[part][key] == pytest.approx(value, abs=1e3 * PRINTED_M)
    assert main(['evaluate', *files]) == 0
    assert f'{report["ate"]["rmse_cm"]:.2f} cm RMSE' in capsys.readouterr().out


@pytest.mark.slow
def test_max_frames_ends_a_run_early(room: Run, tmp_path: Path) -> None:
    words = [f'{key}={value}' for key, value in SETTINGS.items()]
    short = track_into(tmp_path / 'short', ROOM, '--max-frames', '5', '--set', *words)
    assert short.status == 0
    whole = (room.folder / 'trajectory.tum').read_text().splitlines()
    assert (short.folder / 'trajectory.tum').read_text().splitlines() == whole[:6]
    report = short.report()
    assert report['frames'] == 5
    assert report['rpe_1s'] is None
    assert report['interrupted'] is False
    assert 'RPE over 1 s  not computed: no two of 5' in short.out


def test_settings_are_layered(tmp_path: Path) -> None:
    file = tmp_path / 'settings.yaml'
    file.write_text('ablation: shared\nthreads: 1\nsensor: {a_m: 0.002}\ncloud: {stride_px: 9}')
    done = track_into(
        tmp_path / 'run', f'{ROOM}&sensor=ideal', '--max-frames', '2', '--config', str(file),
        '--ablation', 'sigma_t', '--set', 'cloud.stride_px=12', 'timing.memory_s=3',
        '--set', 'timing.colour_depth_offset_ms=none', '--set', 'timing.memory_s=4',
    )  # fmt: skip
    used = apply_file(Config(), done.folder / 'config.yaml')
    assert (used.ablation, used.threads) == ('sigma_t', 1)
    assert used.sensor == replace(open_source('synthetic:room?sensor=ideal').sensor, a_m=0.002)
    assert used.cloud.stride_px == 12
    assert used.timing.memory_s == 4
    assert used.timing.colour_depth_offset_ms is None
    assert done.report()['ablation'] == 'sigma_t'


@pytest.mark.slow
def test_the_truth_never_reaches_the_tracker(tum_folder: Writer, tmp_path: Path) -> None:
    folder = held_still(tum_folder(frames=6))
    words = (str(folder), '--camera', SMALL, *WALL)
    with_truth = track_into(tmp_path / 'with', *words)
    (folder / 'groundtruth.txt').unlink()
    without = track_into(tmp_path / 'without', *words)
    assert with_truth.report()['ate'] is not None
    assert without.report()['ate'] is None
    assert 'ATE           not computed: there is no ground truth' in without.out
    text = (with_truth.folder / 'trajectory.tum').read_bytes()
    assert (without.folder / 'trajectory.tum').read_bytes() == text


def test_truth_of_another_time_leaves_the_run_without_ate(
    tum_folder: Writer, tmp_path: Path
) -> None:
    truth = tmp_path / 'truth.tum'
    truth.write_text('7 0 0 0 0 0 0 1\n8 1 0 0 0 0 0 1\n9 1 1 0 0 0 0 1\n')
    folder = str(held_still(tum_folder()))
    words = (folder, '--camera', SMALL, '--groundtruth', str(truth), *WALL)
    done = track_into(tmp_path / 'run', *words)
    assert done.status == 0
    assert done.report()['ate'] is None
    assert 'found 0 of 3 poses' in done.out
    assert (done.folder / 'trajectory.png').exists()


def corner(camera: PinholeCamera) -> NDArray[np.float32]:
    """Return the depth (H, W) of three walls that meet 0.8 m before the camera."""
    angles = np.arange(3) * 2.0 * np.pi / 3.0
    normals = np.sqrt([[2.0, 2.0, 1.0]]) * np.stack([np.cos(angles), np.sin(angles), [1.0] * 3], 1)
    ahead = camera.undistortion_map @ normals[:, :2].T + normals[:, 2]
    return (0.8 / ahead.max(axis=2)).astype(np.float32)


class MadeUp:
    """Frames of a room's corner, with other items or actions at given indices; and the truth."""

    name = 'made up'
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    sensor = SensorNoise()
    depth_per_metre = None
    notes = ()

    def __init__(self, count: int, at: dict[int, Action]) -> None:
        self._count, self._at = count, at
        stamps_ns = 10**9 + 33_000_000 * np.arange(count, dtype=np.int64)
        self.groundtruth = Trajectory(stamps_ns, np.tile(np.eye(4), (count, 1, 1)))

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        depth_m = corner(self.camera)
        for k in range(self._count):
            other = self._at[k]() if k in self._at else None
            stamp_ns = 10**9 + k * 33_000_000
            image = np.full((48, 64, 3), 90 + k % 3, np.uint8)  # equal frames are one, repeated
            frame = RgbdFrame(stamp_ns, stamp_ns, image, depth_m)
            if isinstance(other, np.ndarray):
                frame, other = replace(frame, depth_m=other), None
            yield other or frame


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Run]:
    """Return a function that runs `MadeUp` frames."""

    def run_made_up(count: int, at: dict[int, Action]) -> Run:
        monkeypatch.setattr(run, 'open_source', lambda *_: MadeUp(count, at))
        return track_into(tmp_path / 'run', 'made-up', *WALL)

    return run_made_up


def bad_frame() -> BadFrame:
    return BadFrame('frame 3 of 6 (3.png)', 'is cut off')


def noise() -> NDArray[np.float32]:
    """Return depth of no surface at all."""
    return np.random.default_rng(0).uniform(0.5, 6.0, (48, 64)).astype(np.float32)


def test_a_lost_frame_is_not_tracked(made_up: Callable[..., Run]) -> None:
    """It has a line, but no pose, and the ATE says that it does not cover it."""
    done = made_up(60, dict.fromkeys(range(40, 46), noise))
    assert done.status == 0
    report, rows = done.report(), done.frames()
    assert (report['frames'], report['tracked'], report['lost']) == (60, 54, 6)
    assert report['states']['lost'] == {'frames': 6, 'longest_s': pytest.approx(6 * 0.033)}
    assert report['ate']['coverage'] == pytest.approx(54 / 60)
    assert report['silent_frames'] == 0
    lost = [row['state'] == 'lost' for row in rows]
    assert [k for k, is_lost in enumerate(lost) if is_lost] == list(range(40, 46))
    assert [row['tracked'] == '0' for row in rows] == lost
    poses = read_tum(done.folder / 'trajectory.tum')
    assert [format_stamp_ns(stamp_ns) for stamp_ns in poses.stamps_ns] == [
        row['stamp'] for row in rows if row['state'] != 'lost'
    ]
    assert 'lost 6 (longest 0.20 s)' in done.out
    assert 'relocalised 5 (longest 0.17 s)' in done.out
    assert 'degenerate' not in done.out  # no frame was
    assert '90.0% of the frames with truth' in done.out


@pytest.mark.parametrize('first', [0, 1])
def test_a_run_that_tracks_nothing_fails_with_everything_written(
    made_up: Callable[..., Run], first: int
) -> None:
    done = made_up(6, dict.fromkeys(range(first, 6), noise))
    assert done.status == 2
    assert done.err.splitlines()[-1].startswith(
        f'dcgs: nothing was tracked: the camera is lost in {6 - first} of 6 frames'
    )
    assert "the depth lies in the sensor's range of 0.3 to 5 m" in done.err
    assert done.files() == (TRACKS if first else TRACKS - {'trajectory.png'})
    report = done.report()
    assert (report['tracked'], report['lost'], report['ate']) == (first, 6 - first, None)
    assert 'ATE           not computed' in done.out


@pytest.mark.parametrize('stamp_ns', [0, 10**9])
def test_equal_stamps_are_one_frame_and_a_failed_run(
    made_up: Callable[..., Run], monkeypatch: pytest.MonkeyPatch, stamp_ns: int
) -> None:
    """All but the first frame are refused: that is said, and nothing was tracked."""
    read = MadeUp.__iter__
    monkeypatch.setattr(
        MadeUp, '__iter__', lambda self: (restamped(f, stamp_ns) for f in read(self))
    )
    done = made_up(6, {})
    assert done.status == 2
    line = done.err.splitlines()[-1]
    assert line.startswith('dcgs: nothing was tracked: the camera is lost in 0 of 6 frames')
    assert '5 are skipped; the first: frame 2: stamp lies 0.000000 s before the last frame' in line
    assert done.files() == TRACKS


def restamped(frame: RgbdFrame | BadFrame, stamp_ns: int) -> RgbdFrame | BadFrame:
    assert isinstance(frame, RgbdFrame)
    return replace(frame, stamp_ns=stamp_ns, depth_stamp_ns=stamp_ns)


def test_one_frame_an_hour_ahead_does_not_end_tracking(
    made_up: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    read = MadeUp.__iter__

    def ahead(self: MadeUp) -> Iterator[RgbdFrame | BadFrame]:
        for k, frame in enumerate(read(self)):
            assert isinstance(frame, RgbdFrame)
            yield restamped(frame, frame.stamp_ns + 3600 * 10**9) if k == 10 else frame

    monkeypatch.setattr(MadeUp, '__iter__', ahead)
    done = made_up(40, {})
    report = done.report()
    assert (report['frames'], report['skipped']) == (40, 0)
    assert report['tracked'] >= 38


def test_depth_in_another_unit_is_named_where_nothing_is_tracked(
    made_up: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MadeUp, 'depth_per_metre', 1000.0)
    done = made_up(6, dict.fromkeys(range(6), lambda: 30 * corner(MadeUp.camera)))
    assert done.status == 2
    line = done.err.splitlines()[-1]
    assert "0% of the depth lies in the sensor's range of 0.3 to 5 m" in line
    assert 'at 1000 per metre' in line and '--depth-per-metre' in line
    assert line.count('of the depth lies') == 1


def test_wall_time_is_all_that_the_user_waited_for(
    made_up: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    """From before the kernels are loaded to after the last picture is drawn."""
    moments, start, write_plot = [], run.start, session.write_plot

    def noted_start(*arguments: Any) -> Any:
        moments.append(time.perf_counter())
        return start(*arguments)

    def noted_plot(*arguments: Any) -> None:
        time.sleep(0.2)
        write_plot(*arguments)
        moments.append(time.perf_counter())

    monkeypatch.setattr(run, 'start', noted_start)
    monkeypatch.setattr(session, 'write_plot', noted_plot)
    before = time.perf_counter()
    done = made_up(6, {})
    waited_s = time.perf_counter() - before
    report, rows = done.report(), done.frames()
    assert 1e-3 * sum(float(row['ms']) for row in rows) < report['frames_s']
    assert report['frames_s'] < moments[1] - moments[0] < report['wall_s'] < waited_s
    assert report['realtime_factor'] == pytest.approx(5 * 0.033 / report['frames_s'])


def test_a_bad_frame_is_skipped_counted_and_named(made_up: Callable[..., Run]) -> None:
    done = made_up(6, {2: bad_frame})
    assert done.status == 0
    assert 'dcgs: skipped frame 3 of 6 (3.png): is cut off' in done.err.splitlines()
    report = done.report()
    assert (report['frames'], report['skipped']) == (6, 1)
    assert report['tracked'] + report['lost'] == 5
    rows = done.frames()
    assert [row['state'] == 'skipped' for row in rows] == [k == 2 for k in range(6)]
    assert rows[2]['reason'] == 'frame 3 of 6 (3.png): is cut off'
    assert len(read_tum(done.folder / 'trajectory.tum')) == 5
    assert '1 skipped' in done.out


def test_a_frame_that_the_tracker_refuses_is_skipped(
    made_up: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    track = Tracker.track

    def picky(self: Tracker, frame: RgbdFrame) -> object:
        if frame.stamp_ns == 10**9 + 33_000_000:
            raise FrameError('odd')
        return track(self, frame)

    monkeypatch.setattr(Tracker, 'track', picky)
    done = made_up(4, {})
    assert 'dcgs: skipped frame 2: odd' in done.err.splitlines()
    assert done.frames()[1]['stamp'] == '1.033000000'
    assert done.report()['skipped'] == 1


def test_many_bad_frames_are_named_ten_times(made_up: Callable[..., Run]) -> None:
    done = made_up(30, dict.fromkeys(range(5, 20), bad_frame))
    lines = [line for line in done.err.splitlines() if 'skipped' in line]
    assert len(lines) == 11
    assert lines[-1] == 'dcgs: skipped 15 frames in all'
    assert done.report()['skipped'] == 15


def test_a_run_of_bad_frames_is_refused(made_up: Callable[..., Run]) -> None:
    done = made_up(5, dict.fromkeys(range(5), bad_frame))
    assert done.status == 2
    assert done.err.splitlines()[-1] == (
        'dcgs: no usable frame: 5 of 5 skipped; the first: frame 3 of 6 (3.png): is cut off'
    )
    assert not done.folder.exists()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_with_everything_written(
    made_up: Callable[..., Run], number: signal.Signals
) -> None:
    def twice() -> None:  # as `timeout` and launchers do
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), number)

    before = signal.getsignal(number)
    done = made_up(10_000, {3: twice})
    assert done.status == 128 + number
    assert signal.getsignal(number) is before
    assert done.files() == TRACKS
    report = done.report()
    assert report['interrupted'] is True
    assert 1 <= report['frames'] < 10_000
    assert len(read_tum(done.folder / 'trajectory.tum')) == report['frames']
    assert 'interrupted' in done.out


@pytest.mark.parametrize('error', [RuntimeError('bug'), OSError(28, 'No space left', 'x.png')])
def test_a_failure_loses_nothing_that_was_tracked(
    made_up: Callable[..., Run], tmp_path: Path, error: Exception
) -> None:
    def fail() -> None:
        raise error

    if isinstance(error, OSError):
        done = made_up(9, {4: fail})
        assert done.status == 2
        assert done.err.splitlines()[-1] == 'dcgs: x.png: No space left'
    else:
        with pytest.raises(RuntimeError, match='bug'):
            made_up(9, {4: fail})
    assert len(read_tum(tmp_path / 'run' / 'trajectory.tum')) == 4
    assert json.loads((tmp_path / 'run' / 'report.json').read_text())['interrupted'] is True
    assert 'prefetch' not in {thread.name for thread in threading.enumerate()}


@pytest.mark.slow
def test_runs_without_a_folder_of_their_own_are_numbered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        assert main(['run', 'synthetic:plane?frames=1&sensor=ideal', '--no-mapping']) == 0
        folder = f'runs/synthetic-plane-frames-1-sensor-ideal-{number}'
        assert f'{folder}/trajectory.png' in capsys.readouterr().out
        assert (tmp_path / folder / 'trajectory.tum').exists()


@pytest.mark.slow
def test_ctrl_c_on_a_process_writes_the_trajectory(tmp_path: Path) -> None:
    words = ['run', 'synthetic:room?frames=100000', '--no-mapping', '--out', str(tmp_path / 'run')]
    process = subprocess.Popen(
        [sys.executable, '-m', 'dcgs_ros.cli', *words],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith('dcgs: tracking'):
            break
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 130, err
    assert 'interrupted' in out
    assert 'Traceback' not in err
    assert len(read_tum(tmp_path / 'run' / 'trajectory.tum')) >= 1
