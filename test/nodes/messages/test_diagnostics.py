# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A node's health as a message."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import deserialize_message, serialize_message

from dcgs_ros.nodes.health import Level, Verdict
from dcgs_ros.nodes.messages.diagnostics import diagnostics
from dcgs_ros.nodes.messages.images import time_message


@pytest.mark.parametrize(
    ('level', 'sent'), [(Level.OK, b'\x00'), (Level.WARN, b'\x01'), (Level.ERROR, b'\x02')]
)
def test_a_verdict_survives_the_wire(level: Level, sent: bytes) -> None:
    message = diagnostics(time_message(5), 'eye: tracking', Verdict(level, 'why'), {'frames': 12})
    got = deserialize_message(serialize_message(message), DiagnosticArray)
    assert got == message and got.header.stamp == time_message(5)
    (status,) = got.status
    assert (status.level, status.name, status.message) == (sent, 'eye: tracking', 'why')
    assert [(value.key, value.value) for value in status.values] == [('frames', '12')]


@pytest.mark.parametrize(
    ('value', 'text'),
    [(3.14159265, '3.142'), (1e-9, '1e-09'), (float('nan'), 'nan'), (12345678, '12345678'),
     (True, 'True'), ('lost', 'lost'), (None, 'None')],
)  # fmt: skip
def test_values_are_text_that_people_read(value: object, text: str) -> None:
    message = diagnostics(time_message(5), 'a', Verdict(Level.OK, 'b'), {'key': value})
    (shown,) = message.status[0].values
    assert (shown.key, shown.value) == ('key', text)
