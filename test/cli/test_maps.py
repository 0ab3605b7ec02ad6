# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs convert` between the formats of maps, and what PlayCanvas' own tool makes of them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from dcgs_ros.cli.main import main
from dcgs_ros.core.mapping.splats import PLANES, Splats
from dcgs_ros.io.ply import read_ply, write_ply
from dcgs_ros.io.spz import read_spz, write_spz

BITS_M, BITS_LOG = 0.51 / 4096, 0.51 / 16  # half a step of SPZ's positions and sizes
ROUNDING = 1e-6  # of float32


def random_splats(count: int) -> Splats:
    planes = np.random.default_rng(3).normal(size=(14, count)).astype(np.float32)
    planes[3:6] -= 4
    return Splats(planes)


def assert_close(found: Splats, expected: Splats, position_m: float, size: float) -> None:
    assert np.abs(found.means - expected.means).max() <= position_m
    assert np.abs(found.log_scales - expected.log_scales).max() <= size


def test_a_map_goes_to_spz_and_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    splats = random_splats(300)
    ply, spz, back = (tmp_path / name for name in ('a.ply', 'b.SPZ', 'c.ply'))
    write_ply(ply, splats)
    assert main(['convert', str(ply), str(spz)]) == 0
    assert str(spz) in capsys.readouterr().out
    assert main(['convert', str(spz), str(back)]) == 0
    assert_close(read_ply(back), splats, BITS_M, BITS_LOG)
    assert spz.stat().st_size < ply.stat().st_size / 3


def test_an_ascii_map_with_infinite_opacities_is_read_and_they_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    splats = random_splats(5)
    lines = ['ply', 'format ascii 1.0', 'element vertex 5']
    lines += [*(f'property float {name}' for name in PLANES), 'end_header']
    rows = splats.planes.T.copy()
    rows[1, 10], rows[3, 10] = np.inf, np.nan
    lines += [' '.join(str(number) for number in row) for row in rows]
    source, dest = tmp_path / 'a.ply', tmp_path / 'b.ply'
    source.write_text('\n'.join(lines) + '\n')
    assert main(['convert', str(source), str(dest)]) == 0
    warning = f'dcgs: {source}: 2 of 5 Gaussians are not finite and are left out\n'
    assert capsys.readouterr().err == warning
    assert np.array_equal(read_ply(dest).planes, np.delete(splats.planes, [1, 3], axis=1))


def test_maps_that_cannot_be_converted_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_ply(tmp_path / 'a.ply', random_splats(2))
    write_ply(tmp_path / 'none.ply', random_splats(0))
    source, dest = str(tmp_path / 'a.ply'), str(tmp_path / 'b.spz')
    (tmp_path / 'there.spz').write_text('mine')
    for words, reason in (
        ([source, str(tmp_path / 'there.spz')], 'there.spz exists: no file is overwritten'),
        ([source, dest, '--format', 'mcap'], '--format and the other options are for sequences'),
        ([str(tmp_path / 'none.ply'), dest], 'none.ply: holds no Gaussian'),
        ([str(tmp_path / 'gone.ply'), dest], 'gone.ply: cannot be read'),
        ([str(tmp_path), dest], 'cannot be read: Is a directory'),
        ([str(tmp_path / 'there.spz'), dest], "no SPZ: begins with b'mine'"),
    ):
        assert main(['convert', *words]) == 2
        err = capsys.readouterr().err
        assert reason in err
        assert len(err.splitlines()) == 1
    assert (tmp_path / 'there.spz').read_text() == 'mine'
    assert not Path(dest).exists()


@pytest.mark.slow
def test_playcanvas_reads_what_is_written_and_what_it_writes_is_read(tmp_path: Path) -> None:
    """Its `splat-transform` is the library of SuperSplat."""
    command = shutil.which('splat-transform')
    if command is None:
        pytest.skip('no splat-transform: npm install -g @playcanvas/splat-transform')

    def transform(source: str, dest: str, *words: str) -> Path:
        names = [str(tmp_path / source), str(tmp_path / dest)]
        subprocess.run([command, '--quiet', *names, *words], check=True, timeout=60)
        return tmp_path / dest

    splats = random_splats(1000)
    write_ply(tmp_path / 'map.ply', splats)
    write_spz(tmp_path / 'map.spz', splats)
    assert np.array_equal(read_ply(transform('map.ply', 'same.ply')).planes, splats.planes)
    theirs = read_ply(transform('map.spz', 'spz.ply'))
    assert np.allclose(theirs.planes, read_spz(tmp_path / 'map.spz').planes, atol=ROUNDING)
    for version in ('3', '4'):
        packed = transform('map.ply', f'{version}.spz', '--spz-version', version)
        assert_close(read_spz(packed), splats, BITS_M, BITS_LOG)
    compressed = transform('map.ply', 'a.compressed.ply')
    unpacked = read_ply(transform('a.compressed.ply', 'b.ply'))
    assert np.allclose(read_ply(compressed).planes, unpacked.planes, atol=ROUNDING)
