# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Pairing by stamp, with losses, delays and disorder."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterable, Sequence

from hypothesis import given
from hypothesis import strategies as st

from dcgs_ros.nodes.tracking.pairing import ImagePair, ImagePairing

MS = 1_000_000
START = 1_700_000_000 * 10**9
PERIOD = 33 * MS
SLOP = 16 * MS
CAPACITY = 8

Event = tuple[str, int]  # stream and stamp
# Less than a second in all: nothing of it is a clock that jumped.
SOUP = st.lists(
    st.tuples(st.sampled_from(['color', 'depth']), st.integers(0, 900).map(lambda k: k * MS)),
    max_size=80,
)


def fed(
    pairing: ImagePairing[int, int], events: Iterable[Event]
) -> list[list[ImagePair[int, int]]]:
    """Return the pairs that leave after each event; an item is its stamp."""
    return [getattr(pairing, stream)(START + at, START + at) for stream, at in events]


def stamps(batches: Sequence[list[ImagePair[int, int]]]) -> list[tuple[int, int]]:
    return [(p.color_ns - START, p.depth_ns - START) for batch in batches for p in batch]


@given(SOUP)
def test_pairs_are_in_order_within_the_slop_and_use_nothing_twice(events: list[Event]) -> None:
    pairing: ImagePairing[int, int] = ImagePairing(SLOP, CAPACITY)
    batches = fed(pairing, events)
    pairs = [pair for batch in batches for pair in batch]
    assert all(p.color == p.color_ns and p.depth == p.depth_ns for p in pairs)
    assert all(abs(p.color_ns - p.depth_ns) <= SLOP for p in pairs)
    for before, after in itertools.pairwise(pairs):
        assert before.color_ns < after.color_ns
        assert before.depth_ns < after.depth_ns
    assert pairing.paired == len(pairs)


@given(SOUP)
def test_every_image_is_paired_dropped_or_one_of_a_few_that_wait(events: list[Event]) -> None:
    pairing: ImagePairing[int, int] = ImagePairing(SLOP, CAPACITY)
    fed(pairing, events)
    for stream, dropped in (
        ('color', pairing.unpaired_color),
        ('depth', pairing.unpaired_depth),
    ):
        arrived = sum(name == stream for name, _ in events)
        assert 0 <= arrived - pairing.paired - dropped <= CAPACITY
    pairing.clear()
    assert pairing.unpaired_color + pairing.unpaired_depth + 2 * pairing.paired == len(events)


@given(SOUP)
def test_without_slop_equal_stamps_pair_when_the_second_comes(events: list[Event]) -> None:
    batches = fed(ImagePairing(0, CAPACITY), events)
    for (_, at), left in zip(events, batches, strict=True):
        assert stamps([left]) in ([], [(at, at)])


@given(st.lists(st.sampled_from(['color', 'depth']), max_size=60))
def test_perfect_streams_lose_nothing_however_they_interleave(order: list[str]) -> None:
    pairing: ImagePairing[int, int] = ImagePairing(SLOP, CAPACITY)
    sent = {'color': 0, 'depth': 0}
    events: list[Event] = []
    for wanted in order:
        other = 'depth' if wanted == 'color' else 'color'
        stream = other if sent[wanted] - sent[other] == CAPACITY else wanted
        events.append((stream, PERIOD * sent[stream]))
        sent[stream] += 1
    complete = min(sent.values())
    assert stamps(fed(pairing, events)) == [(PERIOD * k, PERIOD * k) for k in range(complete)]
    assert pairing.unpaired_color == pairing.unpaired_depth == pairing.disorder == 0


@given(st.integers(-15, 15), st.integers(0, 2**32), st.sampled_from(['color', 'depth']))
def test_of_a_stream_with_drops_every_image_that_has_its_partner_is_paired(
    offset_ms: int, seed: int, lossy: str
) -> None:
    """A fifth is dropped; depth is off by a constant time."""
    draw = random.Random(seed)
    kept = {'color': set(range(100)), 'depth': set(range(100))}
    kept[lossy] = {k for k in range(100) if draw.random() > 0.2}
    events = sorted(
        [('color', PERIOD * k) for k in kept['color']]
        + [('depth', PERIOD * k + offset_ms * MS) for k in kept['depth']],
        key=lambda event: event[1],
    )
    pairs = stamps(fed(ImagePairing(SLOP, CAPACITY), events))
    both = sorted(kept['color'] & kept['depth'])
    expected = [(PERIOD * k, PERIOD * k + offset_ms * MS) for k in both]
    assert pairs in (expected, expected[:-1])  # nothing came after the last one


@given(st.integers(-15, 15))
def test_a_pair_of_steady_streams_leaves_with_its_later_image(offset_ms: int) -> None:
    events = sorted(
        [('color', PERIOD * k) for k in range(20)]
        + [('depth', PERIOD * k + offset_ms * MS) for k in range(20)],
        key=lambda event: event[1],
    )
    batches = fed(ImagePairing(SLOP, CAPACITY), events)
    for (_, at), left in list(zip(events, batches, strict=True))[4:]:
        assert all(max(pair) == at for pair in stamps([left]))
    assert len(stamps(batches)) == 20


def test_the_nearer_of_two_is_waited_for() -> None:
    """Colour at 60 Hz, depth at 30 Hz nearer to every second colour image."""
    events = [('color', 0), ('depth', 10 * MS), ('color', 17 * MS), ('depth', 43 * MS)]
    assert stamps(fed(ImagePairing(20 * MS, CAPACITY), events)) == [(17 * MS, 10 * MS)]


def test_images_out_of_order_are_counted_and_still_find_their_partner() -> None:
    pairing: ImagePairing[int, int] = ImagePairing(SLOP, CAPACITY)
    events = [('color', PERIOD), ('color', 0), ('depth', 0), ('depth', PERIOD)]
    assert stamps(fed(pairing, events)) == [(0, 0), (PERIOD, PERIOD)]
    assert pairing.disorder == 1
    # What comes again, or after its successors have left, does not.
    assert stamps(fed(pairing, [('color', 0), ('depth', 0), ('depth', PERIOD)])) == []
    assert (pairing.unpaired_color, pairing.unpaired_depth, pairing.disorder) == (1, 2, 4)


def test_a_clock_that_jumps_back_starts_afresh() -> None:
    pairing: ImagePairing[int, int] = ImagePairing(SLOP, CAPACITY)
    loop: list[Event] = [(s, 10 * PERIOD * k) for k in range(10) for s in ('color', 'depth')]
    fed(pairing, [*loop, ('color', 100 * PERIOD)])
    assert stamps(fed(pairing, loop)) == [(10 * PERIOD * k, 10 * PERIOD * k) for k in range(10)]
    assert (pairing.jumped_back, pairing.paired, pairing.disorder) == (1, 20, 0)
    assert (pairing.unpaired_color, pairing.unpaired_depth) == (1, 0)


def test_a_silent_stream_makes_the_other_drop_its_oldest() -> None:
    pairing: ImagePairing[int, int] = ImagePairing(SLOP, CAPACITY)
    assert not stamps(fed(pairing, [('color', PERIOD * k) for k in range(100)]))
    assert pairing.unpaired_color == 100 - CAPACITY
