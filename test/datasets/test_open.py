# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""An address opens its source, or says why not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from bags import recording, write_bag  # type: ignore[import-not-found]

from dcgs_ros.datasets.images.sequence import ImageSequence
from dcgs_ros.datasets.open import FORMATS, open_source
from dcgs_ros.datasets.source import SourceError
from dcgs_ros.datasets.synthetic.source import SyntheticSource


def test_every_format_is_in_the_documentation() -> None:
    text = (Path(__file__).parents[2] / 'docs/datasets.md').read_text()
    for format_ in FORMATS:
        names = format_.layout.rpartition('(')[2].rstrip(')').removeprefix("NICE-SLAM's ")
        if 'docs' not in names and '--camera' not in names:  # described by the user
            assert all(name in text for name in names.split(', ')), names


def test_a_folder_is_read_as_tum(tum_folder: Callable[..., Path]) -> None:
    source = open_source(str(tum_folder('my_fr2_desk', frames=3)))
    assert isinstance(source, ImageSequence)
    assert source.name == 'my_fr2_desk'
    assert len(source) == 3


def test_camera_and_ground_truth_are_passed_on(tum_folder: Callable[..., Path]) -> None:
    folder = tum_folder('office', frames=3)
    truth = (folder / 'groundtruth.txt').rename(folder / 'truth.txt')
    source = open_source(str(folder), camera='50,50,31.5,23.5', groundtruth=truth)
    assert source.camera.fx == 50
    assert source.groundtruth is not None


def test_synthetic_addresses() -> None:
    source = open_source('synthetic:room?frames=7')
    assert isinstance(source, SyntheticSource)
    assert len(source) == 7


def test_synthetic_sources_have_their_own_camera() -> None:
    with pytest.raises(SourceError, match='its own camera'):
        open_source('synthetic:room', camera='fr1')


def test_what_cannot_be_opened_is_told_why(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match='no such folder'):
        open_source(str(tmp_path / 'nowhere'))
    with pytest.raises(SourceError, match=r'unknown format\. Known formats: .*rgb\.txt'):
        open_source(str(tmp_path))
    (tmp_path / 'file').touch()
    with pytest.raises(SourceError, match='is a file'):
        open_source(str(tmp_path / 'file'))


def test_topics_of_a_recording_are_named_behind_its_path(tmp_path: Path) -> None:
    left, right = (
        list(recording(2, f'/{side}/color/image', f'/{side}/depth/image'))
        for side in ('left', 'right')
    )
    path = write_bag(tmp_path / 'two', [*left, *right])
    with pytest.raises(SourceError, match=r'name it: .*two\?color=TOPIC'):
        open_source(str(path))
    source = open_source(f'{path}?color=/right/color/image&depth=/right/depth/image')
    assert len(list(source)) == 2
    with pytest.raises(SourceError, match='colour is not known; of a recording color=TOPIC'):
        open_source(f'{path}?colour=/right/color/image')


def test_only_recordings_have_topics(tum_folder: Callable[..., Path]) -> None:
    with pytest.raises(SourceError, match='unknown format'):
        open_source(f'{tum_folder("fr1_desk")}?color=/a')
