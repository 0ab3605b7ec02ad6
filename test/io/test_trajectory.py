# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Trajectory files: what is written is what is read, and what is wrong has a line number."""

from __future__ import annotations

import os
import re
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.io.trajectory import (
    TrajectoryFileError,
    format_stamp_ns,
    parse_stamp_ns,
    read_tum,
    write_tum,
)

ROUNDING = 2e-9  # nine decimals, and the normalisation of a quaternion rounded to them
STAMPS_NS = st.integers(-(2**62) + 1, 2**62 - 1)
GOOD = '1.5 1 2 3 0 0 0 1\n'


@st.composite
def trajectories(draw: st.DrawFn) -> Trajectory:
    stamps = draw(st.lists(STAMPS_NS, unique=True, min_size=1, max_size=20).map(sorted))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    # Turns from none over tiny ones to half a revolution, where q and -q meet.
    angles = draw(st.sampled_from([0.0, 1e-9, 1e-3, 1.0, np.pi]))
    axes = rng.normal(size=(len(stamps), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(angles * axes).as_matrix()
    poses[:, :3, 3] = rng.normal(scale=10.0, size=(len(stamps), 3))
    return Trajectory(np.array(stamps, np.int64), poses)


@settings(max_examples=50)
@given(trajectories())
def test_written_then_read_is_the_same(
    tmp_path_factory: pytest.TempPathFactory, trajectory: Trajectory
) -> None:
    path = tmp_path_factory.mktemp('round') / 'trajectory.tum'
    write_tum(path, trajectory)
    again = read_tum(path)
    np.testing.assert_array_equal(again.stamps_ns, trajectory.stamps_ns)
    np.testing.assert_allclose(again.T_world_cam, trajectory.T_world_cam, atol=4 * ROUNDING)


@given(STAMPS_NS)
def test_stamps_survive_exactly(stamp_ns: int) -> None:
    text = format_stamp_ns(stamp_ns)
    assert parse_stamp_ns(text) == stamp_ns
    assert Decimal(text) * 10**9 == stamp_ns


@pytest.mark.parametrize(
    ('text', 'stamp_ns'),
    [
        ('1341841873.273798', 1_341_841_873_273_798_000),
        ('1305031101.1759', 1_305_031_101_175_900_000),
        ('1.341841873273798000e+09', 1_341_841_873_273_798_000),
        ('0', 0),
        ('-0.000000001', -1),
    ],
)
def test_stamps_never_pass_through_a_float(text: str, stamp_ns: int) -> None:
    assert parse_stamp_ns(text) == stamp_ns


@pytest.mark.parametrize('text', ['', 'abc', 'nan', 'inf', '1e11', '4611686018.427387904', '1,5'])
def test_what_is_no_stamp_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match='time in seconds'):
        parse_stamp_ns(text)


def test_quaternions_of_four_decimals_become_rotations(tmp_path: Path) -> None:
    path = tmp_path / 'truth.txt'
    path.write_text('1341841873.4151 -2.1837 0.6821 1.4854 -0.2651 0.7889 -0.5183 0.1970\n')
    rotation = read_tum(path).T_world_cam[0, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0


def test_a_quarter_turn_about_z(tmp_path: Path) -> None:
    path = tmp_path / 'turn.txt'
    half = np.sqrt(0.5)
    path.write_text(f'1.0 1 2 3 0 0 {half} {half}\n')
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(read_tum(path).T_world_cam[0], expected, atol=1e-12)


def test_comments_and_empty_lines_are_skipped(tmp_path: Path) -> None:
    path = tmp_path / 'a.txt'
    path.write_text('# stamp tx ...\n\n  # more\r\n' + GOOD + '\n')
    assert list(read_tum(path).stamps_ns) == [1_500_000_000]


BAD_LINES = {
    'columns': ('2.0 1 2 3 0 0 0', '7 columns, not 8'),
    'word': ('2.0 1 x 3 0 0 0 1', "'x'"),
    'nan': ('2.0 1 nan 3 0 0 0 1', 'not finite: 1 nan 3'),
    'infinity': ('2.0 1 2 inf 0 0 0 1', 'not finite'),
    'zero quaternion': ('2.0 1 2 3 0 0 0 0', 'length 0, not 1'),
    'long quaternion': ('2.0 1 2 3 0 0 0 1.02', r'length 1\.02, not 1'),
    'stamp': ('x 1 2 3 0 0 0 1', "'x' is no time"),
    'duplicate': (GOOD.strip(), r'1\.500000000 does not come after 1\.500000000'),
    'unsorted': ('1.4 1 2 3 0 0 0 1', r'1\.400000000 does not come after 1\.500000000'),
}


@pytest.mark.parametrize('fault', BAD_LINES)
def test_a_bad_line_is_named(tmp_path: Path, fault: str) -> None:
    line, reason = BAD_LINES[fault]
    path = tmp_path / 'bad.txt'
    path.write_text(f'# comment\n{GOOD}{line}\n')
    with pytest.raises(TrajectoryFileError, match=rf'bad\.txt:3: .*{reason}'):
        read_tum(path)


@pytest.mark.parametrize('fault', BAD_LINES)
def test_a_bad_pose_of_many_is_left_out_and_named(tmp_path: Path, fault: str) -> None:
    line, reason = BAD_LINES[fault]
    path, left_out = tmp_path / 'bad.txt', list[str]()
    path.write_text(f'{GOOD}{line}\n2.5 1 2 3 0 0 0 1\n')
    found = read_tum(path, left_out)
    if fault == 'unsorted':  # nothing is wrong with the pose
        assert found.stamps_ns.tolist() == [1_400_000_000, 1_500_000_000, 2_500_000_000]
        assert left_out == [f'{path}: 1 of 3 poses were not in order of their stamps']
    else:
        assert found.stamps_ns.tolist() == [1_500_000_000, 2_500_000_000]
        (note,) = left_out
        assert re.search(rf'left out 1 of 3 poses; the first: .*bad\.txt:2: .*{reason}', note)


def test_a_file_of_bad_poses_is_refused(tmp_path: Path) -> None:
    path = tmp_path / 'bad.txt'
    path.write_text(f'{GOOD}2 0 0 nan 0 0 0 1\n3 0 0 nan 0 0 0 1\n')
    with pytest.raises(TrajectoryFileError, match=r'bad\.txt:2: pose is not finite'):
        read_tum(path, [])


HALF = 0.7071067811865476
TURN = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
TABLES = {
    'commas': f'1.5,1,2,3,0,0,{HALF},{HALF}\n',
    'semicolons': f'1.5;1;2;3;0;0;{HALF};{HALF}\n',
    'commas and blanks': f'1.5, 1, 2, 3, 0, 0, {HALF}, {HALF}\n',
    'tabs': f'1.5\t1\t2\t3\t0\t0\t{HALF}\t{HALF}\n',
    'heading': f'timestamp,tx,ty,tz,qx,qy,qz,qw\n1.5,1,2,3,0,0,{HALF},{HALF}\n',
    'byte order mark': f'\ufeff1.5 1 2 3 0 0 {HALF} {HALF}\n',
    'w first': f'#timestamp, x, y, z, qw, qx, qy, qz\n1.5,1,2,3,{HALF},0,0,{HALF}\n',
    'EuRoC': '#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], '
    'q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], '
    'b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], '
    'b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n'
    f'1500000000000000000,1,2,3,{HALF},0,0,{HALF},9,9,9,9,9,9,9,9,9\n',
}


@pytest.mark.parametrize('kind', TABLES)
def test_tables_as_other_tools_write_them(tmp_path: Path, kind: str) -> None:
    path = tmp_path / 'truth.csv'
    path.write_text(TABLES[kind], encoding='utf-8')
    found = read_tum(path)
    np.testing.assert_allclose(found.T_world_cam[0], TURN, atol=1e-12)
    assert found.stamps_ns[0] == (1_500_000_000 if kind != 'EuRoC' else 1_500_000_000 * 10**9)


@pytest.mark.parametrize('digits', [3, 6, 9])
def test_whole_numbers_since_1970_tell_their_unit(digits: int) -> None:
    assert parse_stamp_ns('1403636579' + '763555584'[:digits]) == int(
        '1403636579' + '763555584'[:digits].ljust(9, '0')
    )


def test_other_whole_numbers_are_nanoseconds_of_a_clock_since_boot() -> None:
    assert parse_stamp_ns('123456789012') == 123_456_789_012
    assert parse_stamp_ns('1234567890') == 1_234_567_890_000_000_000


def test_a_bad_first_row_is_no_heading(tmp_path: Path) -> None:
    path, left_out = tmp_path / 'a.txt', list[str]()
    path.write_text(f'nan nan nan nan nan nan nan nan\n{GOOD}')
    assert len(read_tum(path, left_out)) == 1
    assert 'left out 1 of 2 poses' in left_out[0]


def test_files_that_hold_nothing_or_are_none(tmp_path: Path) -> None:
    (tmp_path / 'empty.txt').write_text('# only a comment\n')
    with pytest.raises(TrajectoryFileError, match=r'empty\.txt: holds no pose'):
        read_tum(tmp_path / 'empty.txt')
    with pytest.raises(TrajectoryFileError, match='No such file'):
        read_tum(tmp_path / 'nowhere.txt')
    with pytest.raises(TrajectoryFileError, match='cannot be read'):
        read_tum(tmp_path)


def test_an_interrupted_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / 'a.tum'
    path.write_text(GOOD)

    def fail(*_: object) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'replace', fail)
    trajectory = Trajectory(np.array([1, 2]), np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(TrajectoryFileError, match='cannot be written: No space left'):
        write_tum(path, trajectory)
    assert path.read_text() == GOOD
    assert list(tmp_path.iterdir()) == [path]


def test_an_empty_trajectory_is_a_header(tmp_path: Path) -> None:
    write_tum(tmp_path / 'a.tum', Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4))))
    assert (tmp_path / 'a.tum').read_text() == '# timestamp tx ty tz qx qy qz qw\n'
