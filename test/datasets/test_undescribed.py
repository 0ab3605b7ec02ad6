# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Folders that nothing describes are read with what the user tells, or a dcgs.yaml is proposed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import folders  # type: ignore[import-not-found]
import numpy as np
import pytest

from dcgs_ros.cli.main import main
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.options import SourceOptions
from dcgs_ros.datasets.source import SourceError
from dcgs_ros.datasets.undescribed.layout import find_image_folders

SMALL = '60,61,31.5,23.5'
# Patterns of colour and depth, with {} for a number, as datasets and recorders call them.
NAMES = {
    'TUM without numbers of time': ('rgb/{:04d}.png', 'depth/{:04d}.png'),
    'Open3D': ('color/{:06d}.jpg', 'depth/{:06d}.png'),
    'Redwood': ('image/{:07d}-000000033.jpg', 'depth/{:07d}-000000033.png'),
    'RGB-D Scenes v2': ('{:05d}-color.png', '{:05d}-depth.png'),
    'NYU': ('rgb_{:05d}.jpg', 'sync_depth_{:05d}.png'),
    'masks too': ('images/{:d}.png', 'depths/{:d}.png', 'masks/{:d}.png'),
    'Matterport': ('i{:d}_0_0.jpg', 'depth/d{:d}_0_0.png'),
}


def write(folder: Path, patterns: tuple[str, ...], numbers: range = range(8, 12)) -> Path:
    """Write depth of 1 + k / 10 m in millimetres."""
    for number in numbers:
        for k, pattern in enumerate(patterns):
            image = folders.color_of(number)
            if k == 1:
                image = np.full((48, 64), 1000 + 100 * number, np.uint16)
            folders.write_image(folder / pattern.format(number), image)
    return folder


@pytest.mark.parametrize('kind', NAMES)
def test_info_proposes_a_description_that_reads_the_folder(
    tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write(tmp_path / 'mine', NAMES[kind])
    assert main(['info', str(folder)]) == 0
    said, _, proposal = capsys.readouterr().out.partition('\n\n')
    assert '4 colour images' in said and 'give --camera, --depth-per-metre, --rate-hz' in said
    assert 'depth_per_metre: 1000' in proposal and proposal.count('CHECK') == 4
    (folder / 'dcgs.yaml').write_text(proposal)
    source = open_source(str(folder))
    assert (source.camera.width, source.camera.height) == (64, 48)
    for k, frame in enumerate(folders.good_frames(source)):
        assert np.abs(frame.color.astype(int) - folders.color_of(8 + k)).max() <= 4  # of a JPEG
        np.testing.assert_allclose(frame.depth_m, 1.8 + 0.1 * k, rtol=1e-6)


def test_what_is_told_is_enough(tmp_path: Path) -> None:
    folder = write(tmp_path / 'mine', NAMES['Open3D'])
    with pytest.raises(SourceError, match=r'give --rate-hz, or write a dcgs\.yaml'):
        open_source(f'{folder}?depth_per_metre=1000', SMALL)
    source = open_source(f'{folder}?depth_per_metre=1000&rate_hz=15', SMALL)
    assert source.camera.fx == 60
    frames = folders.good_frames(source)
    assert [frame.stamp_ns for frame in frames] == [0, 66666667, 133333333, 200000000]
    np.testing.assert_allclose(frames[0].depth_m, 1.8, rtol=1e-6)


@pytest.mark.parametrize('unit_ns', [1, 10**9])
def test_stamped_names_need_no_index_files(
    tum_folder: Callable[..., Path], unit_ns: int, tmp_path: Path
) -> None:
    """The rest is as in TUM's layout, ground truth included."""
    folder = tum_folder(frames=4)
    with_index = folders.good_frames(open_source(str(folder), SMALL))
    start_ns = 0 if unit_ns > 1 else 17 * 10**17
    for kind, lag_ns in (('rgb', 0), ('depth', 5_000_000)):
        (folder / f'{kind}.txt').unlink()
        for k in range(4):
            stamp_ns = start_ns + 100 * 10**9 + 30_000_000 * k + lag_ns
            name = f'{stamp_ns / 1e9:.6f}' if unit_ns > 1 else str(stamp_ns)
            (folder / kind / f'{k}.png').rename(folder / kind / f'{name}.png')
    source = open_source(str(folder), SMALL)
    assert source.depth_per_metre == 5000
    assert source.groundtruth is not None
    pairs = zip(folders.good_frames(source), with_index, strict=True)
    for ours, theirs in pairs:
        assert ours.stamp_ns == start_ns + theirs.stamp_ns
        assert ours.depth_stamp_ns == start_ns + theirs.depth_stamp_ns
        np.testing.assert_array_equal(ours.depth_m, theirs.depth_m)


@pytest.mark.parametrize('name', ['scan.r3d', 'scan/depth/0.exr'])
def test_a_record3d_export_is_named_with_the_remedy(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    source = path if path.suffix == '.r3d' else path.parents[1]
    with pytest.raises(SourceError, match=r'Record3D.*16-bit PNGs.*dcgs\.yaml'):
        open_source(str(source))


@pytest.mark.parametrize(
    'patterns',
    [('rgb/{}.png',), ('rgb/{}.txt', 'depth/{}.png'), ('x/{}.png', 'deep/{}.png'), ('rgb/a.png',)],
)
def test_other_folders_are_none(tmp_path: Path, patterns: tuple[str, ...]) -> None:
    for pattern in patterns:
        (tmp_path / pattern).parent.mkdir()
        (tmp_path / pattern.format(1)).touch()
    assert find_image_folders(tmp_path) is None
    with pytest.raises(SourceError, match='unknown format'):
        open_source(str(tmp_path), options=SourceOptions(rate_hz=1))
