# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What /diagnostics gets."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.serialization import deserialize_message, serialize_message

from dcgs_ros.nodes.messages.standard import diagnostics, status, time_message


def test_statuses_survive_the_wire() -> None:
    fine = status(DiagnosticStatus.OK, 'tracker', 'tracking', {'frames': 12})
    bad = status(DiagnosticStatus.ERROR, 'tracker: images', 'no images for 3 s', {})
    sent = diagnostics(time_message(5), [fine, bad])
    got = deserialize_message(serialize_message(sent), DiagnosticArray)
    assert got.status == [fine, bad]
    assert got.header.stamp == time_message(5)
    assert [entry.level for entry in got.status] == [b'\x00', b'\x02']


@pytest.mark.parametrize(
    ('value', 'text'),
    [(3.14159265, '3.142'), (1e-9, '1e-09'), (float('nan'), 'nan'), (12345678, '12345678'),
     (True, 'True'), ('lost', 'lost'), (None, 'None')],
)  # fmt: skip
def test_values_are_text_that_people_read(value: object, text: str) -> None:
    (shown,) = status(DiagnosticStatus.OK, 'a', 'b', {'key': value}).values
    assert (shown.key, shown.value) == ('key', text)
