# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What tests of several folders share."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import settings

ROOT = Path(__file__).resolve().parents[1]

# No example is too slow for a machine. `make quick` draws fewer of them.
settings.register_profile('thorough', deadline=None)
settings.register_profile('quick', deadline=None, max_examples=20)
settings.load_profile('thorough')


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Fast tests first: a mistake shows in seconds."""
    items.sort(key=lambda item: item.get_closest_marker('slow') is not None)


@pytest.fixture(scope='session')
def data_dir() -> Path:
    """Folder of the real sequences."""
    value = os.environ.get('DCGS_TEST_DATA')
    if not value:
        pytest.skip('DCGS_TEST_DATA does not name the folder of real sequences')
    if not Path(value).is_dir():
        pytest.skip(f'DCGS_TEST_DATA={value} is no folder')
    return Path(value)


@pytest.fixture(scope='session')
def loaded_after() -> Callable[[str], set[str]]:
    """Return a function that runs code in a fresh process and returns the modules it loaded."""

    def run(code: str) -> set[str]:
        command = [sys.executable, '-c', f"{code}\nimport sys; print(*sys.modules, sep='\\n')"]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return set(done.stdout.split())

    return run


def write_image(path: Path, image: np.ndarray) -> None:
    """Encode by the path's suffix."""
    encoded, data = cv2.imencode(path.suffix, image)
    assert encoded
    path.write_bytes(data.tobytes())


@pytest.fixture
def tum_folder(tmp_path: Path) -> Callable[..., Path]:
    """Return a writer of small datasets in TUM layout.

    Frame k is at 100 + 0.03 k seconds, depth 5 ms later. Its colour is (10 k, 100, 200) in RGB,
    its depth (1 + k / 10) metres at 5000 per metre; the camera stands still.
    """

    def write(
        name: str = 'fr3_small',
        frames: int = 4,
        size: tuple[int, int] = (64, 48),
        interval_s: float = 0.03,
    ) -> Path:
        folder = tmp_path / name
        (folder / 'rgb').mkdir(parents=True)
        (folder / 'depth').mkdir()
        lines: dict[str, list[str]] = {'rgb': ['# colour'], 'depth': [], 'groundtruth': []}
        for k in range(frames):
            color = np.empty((size[1], size[0], 3), np.uint8)
            color[:] = (200, 100, 10 * k)  # BGR, as OpenCV writes
            depth = np.full((size[1], size[0]), 5000 + 500 * k, np.uint16)
            for kind, image, milliseconds in (('rgb', color, 0), ('depth', depth, 5)):
                stamp = f'{100 + interval_s * k + 1e-3 * milliseconds:.6f}'
                write_image(folder / kind / f'{k}.png', image)
                lines[kind].append(f'{stamp} {kind}/{k}.png')
            lines['groundtruth'].append(f'{100 + interval_s * k:.3f} 0 0 0 0 0 0 1')
        for kind, content in lines.items():
            (folder / f'{kind}.txt').write_text('\n'.join(content) + '\n')
        return folder

    return write
