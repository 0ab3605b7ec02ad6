# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The command line: errors are one line and status 2, and it starts quickly."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest

from dcgs_ros import __version__
from dcgs_ros.cli import folders
from dcgs_ros.cli.arguments import OutputFormat
from dcgs_ros.cli.folders import FolderError, new_folder, refuse_used
from dcgs_ros.cli.main import VERBS, main
from dcgs_ros.core.config.presets import QUALITIES, Ablation, Quality
from dcgs_ros.core.config.schema import flatten, settings
from dcgs_ros.core.config.stages import Config

Writer = Callable[..., Path]

ROOT = Path(__file__).resolve().parents[2]
SMALL = '60,61,31.5,23.5'  # intrinsics of the 64x48 images of `tum_folder`
PLANE = 'synthetic:plane?frames=2&sensor=ideal'
Refusal = Callable[..., str]


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Refusal:
    """Return the one line that a command fails with, checking that it writes nothing."""

    def refuse(*words: str) -> str:
        out = tmp_path / 'out'
        extra = ['--out', str(out)] if words[0] == 'run' and '--out' not in words else []
        extra += ['--no-mapping'] if words[0] == 'run' else []
        assert main([*words, *extra]) == 2
        captured = capsys.readouterr()
        assert captured.out == ''
        assert not out.exists()
        lines = captured.err.splitlines()
        notices = ('dcgs: tracking', 'dcgs: skipped', 'dcgs: compiling')
        lines = [line for line in lines if not line.startswith(notices)]
        assert len(lines) == 1
        assert lines[0].startswith('dcgs: ')
        return lines[0]

    return refuse


@pytest.mark.parametrize(
    ('words', 'reason'),
    [
        (['--max-frames', '0'], '--max-frames 0'),
        (['--max-frames', '-3'], '--max-frames -3'),
        (['--render-every', '-1'], '--render-every -1'),
        (['--set', 'sensor.a_m'], '--set sensor.a_m: expected stage.field=value'),
        (['--set', 'sensor.a_m=wide'], "'wide'"),
        (['--set', 'sensor.a_m=-1'], 'a_m > 0'),
        (['--set', 'threads=1', 'cloud.stride_px=1.5'], 'cloud.stride_px'),
        (['--config', 'missing.yaml'], 'missing.yaml: cannot be read'),
        (['--camera', 'fr1'], 'brings its own camera'),
        (['--groundtruth', 'truth.tum'], 'brings its own camera'),
    ],
)
def test_wrong_arguments(refusal: Refusal, words: list[str], reason: str) -> None:
    assert reason in refusal('run', PLANE, *words)


def test_an_unknown_setting_is_answered_with_the_valid_ones(refusal: Refusal) -> None:
    line = refusal('run', PLANE, '--set', 'sensor.a_mm=1')
    assert all(key in line for key in flatten(Config()))


@pytest.mark.parametrize('text', ['[' * 3000 + ']' * 3000, 'sensor: &a {a_m: *a}'])
def test_settings_without_an_end_are_one_line(refusal: Refusal, tmp_path: Path, text: str) -> None:
    (tmp_path / 'endless.yaml').write_text(text)
    line = refusal('run', PLANE, '--config', str(tmp_path / 'endless.yaml'))
    assert 'endless.yaml: no ' in line


@pytest.mark.parametrize('verb', ['run', 'info'])
def test_paths_that_are_not_a_sequence(refusal: Refusal, tmp_path: Path, verb: str) -> None:
    file = tmp_path / 'file.txt'
    file.write_text('x')
    (tmp_path / 'empty').mkdir()
    assert 'no such folder' in refusal(verb, str(tmp_path / 'missing'))
    assert 'is a file' in refusal(verb, str(file))
    assert str(tmp_path / 'empty') in refusal(verb, str(tmp_path / 'empty'))
    assert 'room' in refusal(verb, 'synthetic:attic')
    assert 'frames' in refusal(verb, 'synthetic:room?frame=3')


def test_broken_datasets(refusal: Refusal, tum_folder: Writer) -> None:
    folder = tum_folder(name='nameless')
    assert '--camera' in refusal('run', str(folder))
    words = ('run', str(folder), '--camera', SMALL)
    index = folder / 'rgb.txt'
    good = index.read_text()
    index.write_text(good + '100.5 rgb/9.png 8\n')
    assert 'rgb.txt:6: 3 columns' in refusal(*words)
    index.write_text(good.replace(' rgb', '9 rgb').replace('100.', '300.'))
    assert 'no' in refusal(*words)
    index.write_text(good)
    truth = folder / 'groundtruth.txt'
    truth.write_text('100 nan 0 0 0 0 0 1\n')
    assert 'groundtruth.txt' in refusal(*words)
    assert 'nan' in refusal(*words)
    truth.unlink()
    assert 'missing.tum' in refusal(*words, '--groundtruth', 'missing.tum')


def test_depth_that_is_zero_in_all_frames(refusal: Refusal, tum_folder: Writer) -> None:
    folder = tum_folder(frames=5)
    _, data = cv2.imencode('.png', np.zeros((48, 64), np.uint16))
    for path in (folder / 'depth').iterdir():
        path.write_bytes(data.tobytes())
    line = refusal('run', str(folder), '--camera', SMALL)
    assert line.startswith('dcgs: no usable frame: 5 of 5 skipped; the first: frame 1 of 5')
    assert 'zero' in line


def test_a_folder_in_use_is_refused_before_any_work(refusal: Refusal, tmp_path: Path) -> None:
    used = tmp_path / 'used'
    used.mkdir()
    (used / 'notes.txt').write_text('mine')
    # The source does not exist either: the folder is checked first.
    assert 'not empty' in refusal('run', 'nowhere', '--out', str(used))
    assert [path.name for path in used.iterdir()] == ['notes.txt']
    assert 'is a file' in refusal('run', 'nowhere', '--out', str(used / 'notes.txt'))


def test_a_folder_of_another_run_is_refused_until_that_has_ended(
    refusal: Refusal, tmp_path: Path
) -> None:
    out = tmp_path / 'other'
    with new_folder(out, 'run'):
        line = refusal('run', PLANE, '--out', str(out))
        assert line == f'dcgs: {out} is in use: another process writes there'
        assert out.is_dir()  # not removed by the one that was refused
    assert not out.exists()


def test_what_killed_processes_left_does_not_occupy_a_folder(tmp_path: Path) -> None:
    out = tmp_path / 'out'
    (out / '.map.7.tmp').mkdir(parents=True)
    (out / '.map.dcgs.123.tmp').write_text('half')
    with new_folder(out, 'run') as folder:
        assert list(folder.iterdir()) == []


def test_a_folder_with_something_else_is_left_as_it_is(tmp_path: Path) -> None:
    for name in ('.map.dcgs.123.tmp', 'notes.txt'):
        (tmp_path / name).write_text('mine')
    with pytest.raises(FolderError, match='is not empty'):
        refuse_used(tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_folder_that_another_process_filled_meanwhile_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = folders.locked

    def late(path: Path) -> Any:
        (path / 'report.json').write_text('{}')
        return whole(path)

    monkeypatch.setattr(folders, 'locked', late)
    with pytest.raises(FolderError, match='is not empty'), new_folder(tmp_path / 'out', 'run'):
        pass
    assert (tmp_path / 'out' / 'report.json').exists()


def test_numbered_folders_are_freed_of_what_killed_runs_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'runs' / 'a-1').mkdir(parents=True)
    for name in ('trajectory.tum', '.map.ply.9.tmp'):
        (tmp_path / 'runs' / 'a-1' / name).write_text('')
    with new_folder(None, 'a') as folder:
        assert folder == Path('runs/a-2')
    assert [path.name for path in Path('runs/a-1').iterdir()] == ['trajectory.tum']


def test_a_folder_that_cannot_be_made_is_named(refusal: Refusal, tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    below = str(tmp_path / 'file' / 'below')
    assert below in refusal('run', PLANE, '--out', below)


def test_evaluate_names_the_file_that_is_wrong(refusal: Refusal, tmp_path: Path) -> None:
    good, bad, late = (tmp_path / f'{name}.tum' for name in ('good', 'bad', 'late'))
    poses = [f'{k} {k * k} 0 0 0 0 0 1\n' for k in range(5)]
    good.write_text(''.join(poses))
    bad.write_text(poses[0] + '1 nan 0 0 0 0 0 1\n2 nan 0 0 0 0 0 1\n')
    late.write_text(''.join(f'9{line}' for line in poses))
    assert f'{bad}' in refusal('evaluate', str(good), str(bad))
    assert 'missing.tum' in refusal('evaluate', 'missing.tum', str(good))
    assert 'found 0 of 5 poses' in refusal('evaluate', str(good), str(late))


def test_evaluate_leaves_out_a_bad_pose_of_the_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, truth = tmp_path / 'good.tum', tmp_path / 'truth.tum'
    poses = [f'{k} {k * k} 0 0 0 0 0 1\n' for k in range(5)]
    good.write_text(''.join(poses))
    truth.write_text(''.join([*poses, '5 0 0 0 0 0 0 0\n']))
    assert main(['evaluate', str(good), str(truth)]) == 0
    printed = capsys.readouterr()
    assert '5 of 5 poses' in printed.out
    assert f'left out 1 of 6 poses; the first: {truth}:6: quaternion' in printed.err


@pytest.mark.parametrize(
    'words', [[], ['run'], ['fly', 'x'], ['run', 'x', '--fast'], ['render', 'x'], ['info']]
)
def test_unknown_words_exit_with_two(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 2
    assert capsys.readouterr().err


@pytest.mark.parametrize(
    ('words', 'choices'),
    [
        (['run', 'x', '--ablation', 'best'], get_args(Ablation)),
        (['run', 'x', '--quality', 'best'], get_args(Quality)),
        (['convert', 'x', 'y', '--format', 'tar'], get_args(OutputFormat)),
    ],
)
def test_a_wrong_choice_exits_with_two_and_names_the_others(
    words: list[str], choices: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 2
    err = capsys.readouterr().err
    assert words[-1] in err and words[-2] in err
    assert all(choice in err for choice in choices)


def test_the_choices_are_those_of_the_configuration() -> None:
    ablation = next(s for s in settings(Config()) if s.key == 'ablation')
    assert ablation.choices == get_args(Ablation)
    assert tuple(QUALITIES) == get_args(Quality)


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['--version']) == 0
    assert capsys.readouterr().out == f'dcgs {__version__}\n'


@pytest.mark.parametrize('verb', VERBS)
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([verb, '--help'])
    assert not caught.value.code
    out = capsys.readouterr().out
    assert '--help' in out
    assert 'default: None' not in out


@pytest.mark.slow
def test_help_imports_nothing_heavy_and_a_run_no_matplotlib(
    loaded_after: Callable[[str], set[str]],
) -> None:
    light = loaded_after('import dcgs_ros.cli.main')
    assert not light & {'numpy', 'numba', 'cv2', 'scipy', 'matplotlib', 'tqdm', 'yaml'}
    running = loaded_after('import dcgs_ros.cli.run')
    assert 'numba' in running
    assert not running & {'matplotlib', 'torch'}


def test_what_is_left_for_a_closed_pipe_goes_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else Python would complain when it exits."""
    reading, writing = os.pipe()
    os.close(reading)

    class Closed(io.StringIO):
        def flush(self) -> None:
            os.write(writing, b'rest')

        def fileno(self) -> int:
            return writing

    monkeypatch.setattr(sys, 'stdout', Closed())
    assert main(['--version']) == 141
    sys.stdout.flush()
    os.close(writing)


@pytest.mark.slow
@pytest.mark.parametrize('words', [['info', PLANE], ['info', '--help'], ['--version']])
def test_a_reader_that_closes_the_pipe_is_no_fault_of_the_input(words: list[str]) -> None:
    for both in (False, True):  # stdout alone, and stderr too
        reading, writing = os.pipe()
        os.close(reading)
        done = subprocess.run(
            [sys.executable, '-m', 'dcgs_ros.cli', *words],
            cwd=ROOT,
            stdout=writing,
            stderr=writing if both else subprocess.PIPE,
            check=False,
        )
        os.close(writing)
        assert done.returncode == 141
        assert not done.stderr


@pytest.mark.slow
def test_the_module_is_the_command() -> None:
    command = [sys.executable, '-m', 'dcgs_ros.cli', 'evaluate', 'a', 'b']
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == f'dcgs: a: cannot be read: {os.strerror(2)}\n'
