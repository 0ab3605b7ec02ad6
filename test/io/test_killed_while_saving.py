# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A process that is killed while it saves a map leaves a whole one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

KILLS = 200
HANGS_S = 120.0  # only a failure takes so long
# Forks a child that saves two maps in turn, and kills it at a random moment of the first saves. A
# process of its own: the test's has threads, which a fork does not survive.
SAVED_AND_KILLED = f"""
import os, signal, sys, time
from pathlib import Path

import numpy as np
from test_map_archive import example

from dcgs_ros.io.map_archive import read_map, write_map

path, rng = Path(sys.argv[1]), np.random.default_rng(7)
maps = [example(3000, 20), example(5000, 30)]
write_map(path, maps[0])
start = time.perf_counter()
write_map(path, maps[1])
write_map(path, maps[0])
longest_s = time.perf_counter() - start
found, leftovers = [], 0
for _ in range({KILLS}):
    child = os.fork()
    if not child:
        while True:
            for saved in maps[::-1]:
                write_map(path, saved)
    time.sleep(rng.uniform(0.0, longest_s))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    leftovers += len(list(path.parent.iterdir())) > 1
    found.append(len(read_map(path).ids))
    assert found[-1] in (3000, 5000)
print(len(found), found.count(3000), found.count(5000), leftovers)
"""


@pytest.mark.slow
def test_a_whole_map_is_there_whenever_saving_is_killed(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, '-c', SAVED_AND_KILLED, str(tmp_path / 'map.dcgs')],
        cwd=Path(__file__).parent, capture_output=True, text=True, timeout=HANGS_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    kills, *counts, leftovers = map(int, done.stdout.split())
    assert kills == KILLS == sum(counts) and min(counts) > 0  # both are saved now and then
    assert leftovers > KILLS / 10  # many were killed in the middle of a file
