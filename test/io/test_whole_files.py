# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Files are on the disk before they replace others, and killed writers leave nothing for long."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dcgs_ros.io.whole_files import locked, remove_leftovers, replacing, staged_folder

ROOT = Path(__file__).resolve().parents[2]
KILLED = """
import os, sys
from pathlib import Path
from dcgs_ros.io.whole_files import replacing, staged_folder

target = Path(sys.argv[1])
with replacing(target / 'a.ply') as file, staged_folder(target / 'bag') as folder:
    file.write_text('half')
    folder.mkdir()
    os.kill(os.getpid(), 9)
"""


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write(path: Path) -> None:
    with replacing(path) as temporary:
        temporary.write_text('new')


def test_contents_reach_the_disk_before_the_name_and_then_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[Any] = []

    def noted(name: str, show: Callable[[Any], Any]) -> None:
        whole = getattr(os, name)

        def noting(*given: Any) -> None:
            done.append(show(given))
            whole(*given)

        monkeypatch.setattr(os, name, noting)

    def synced(given: tuple[int]) -> Any:
        link = Path(os.readlink(f'/proc/self/fd/{given[0]}'))
        return 'folder' if link == tmp_path else link.read_text()

    noted('fsync', synced)
    noted('replace', lambda _: 'replace')
    write(tmp_path / 'a.txt')
    assert done == ['new', 'replace', 'folder']
    done.clear()
    noted('sync', lambda _: 'all')
    noted('rename', lambda _: 'rename')
    with staged_folder(tmp_path / 'bag') as folder:
        folder.mkdir()
    assert done == ['all', 'rename', 'folder']


def test_what_a_killed_process_left_is_removed_by_the_next_writer(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, '-c', KILLED, str(tmp_path)], cwd=ROOT, check=False)
    assert done.returncode == -signal.SIGKILL
    assert len(names(tmp_path)) == 2
    write(tmp_path / 'other.ply')  # which may not know what the other files are
    assert len(names(tmp_path)) == 3
    write(tmp_path / 'a.ply')
    with staged_folder(tmp_path / 'bag') as folder:
        folder.mkdir()
    assert names(tmp_path) == ['a.ply', 'bag', 'other.ply']


def test_files_of_a_living_process_are_left_alone(tmp_path: Path) -> None:
    living = tmp_path / '.a.ply.1.tmp'
    living.write_text('half')
    with locked(living):
        write(tmp_path / 'a.ply')
        remove_leftovers(tmp_path)
        assert names(tmp_path) == ['.a.ply.1.tmp', 'a.ply']
    with replacing(tmp_path / 'a.ply') as temporary:
        remove_leftovers(tmp_path)
        assert temporary.exists()
        assert not living.exists()
        temporary.write_text('newer')


def test_a_lock_is_for_one_and_ends_with_it(tmp_path: Path) -> None:
    with locked(tmp_path) as is_locked:
        assert is_locked
        with pytest.raises(BlockingIOError), locked(tmp_path):
            pass
    with locked(tmp_path):
        pass


def test_file_systems_without_locks_are_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, 'No locks available')

    monkeypatch.setattr(fcntl, 'flock', refuse)
    (tmp_path / '.a.txt.1.tmp').write_text('of whom?')
    write(tmp_path / 'a.txt')
    assert names(tmp_path) == ['.a.txt.1.tmp', 'a.txt']


def test_a_file_that_does_not_reach_the_disk_replaces_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, 'Input/output error')

    (tmp_path / 'a.txt').write_text('old')
    monkeypatch.setattr(os, 'fsync', fail)
    with pytest.raises(OSError, match='Input/output'):
        write(tmp_path / 'a.txt')
    assert (tmp_path / 'a.txt').read_text() == 'old'
    assert names(tmp_path) == ['a.txt']
