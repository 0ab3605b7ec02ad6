# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Which keyframes look like an image: an index over words of ORB's bits, without training.

Each of several tables files a feature under some of its bits, chosen at random once (locality
sensitive hashing; Indyk and Motwani 1998). Features of the same corner differ in few bits, so they
are in the same list of some table. A short list says more than a long one.
"""

from __future__ import annotations

import threading
from collections.abc import Collection

import numpy as np

from ..camera import PinholeCamera
from ..config.stages import Config
from ..frame import RgbdFrame
from ..kernels.jit import kernel
from ..tracking.relocalization import Recognition
from .alignment import Alignment, align
from .features import Features, extract

_TABLES, _BITS = 12, 16
_LONGEST = 2000  # list that still says something
_WORDS = 1 << _BITS
_SELECTED = np.array(
    [np.random.default_rng(k).permutation(256)[:_BITS] for k in range(_TABLES)], np.int64
)
_FEW_FEATURES = 50  # added to a keyframe's number: with few, chance weighs more
_TRIED = 5  # keyframes that look most like a lost frame
_OFFERED = 3  # places


class Places:
    """The keyframes' features, indexed; one thread may add while another asks."""

    def __init__(self, camera: PinholeCamera, config: Config) -> None:
        """Start without keyframes."""
        self._camera, self._config = camera, config
        self._lock = threading.Lock()
        self._features: dict[int, Features] = {}  # by keyframe
        self._known_by_others: set[int] = set()
        self._rows: list[int] = []  # keyframe of each row of the index
        self._sizes: list[int] = []
        self._heads = np.full((_TABLES, _WORDS), -1, np.int32)
        self._counts = np.zeros((_TABLES, _WORDS), np.int32)
        self._next = np.empty((_TABLES, 0), np.int32)
        self._row_of = np.empty(0, np.int32)  # of each feature
        self._used = 0

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self._rows)

    def add(self, keyframe: int, features: Features, is_new: bool = True) -> None:
        """Add a keyframe by its index.

        One whose view is not new has its features until `forget`, but is no candidate.
        """
        if not is_new:
            self._features[keyframe] = features
            self._known_by_others.add(keyframe)
            return
        words = np.empty((_TABLES, len(features)), np.int64)
        _write_words(features.descriptors, _SELECTED, words)
        with self._lock:
            self._reserve(len(features))
            row = len(self._rows)
            _file(words, self._used, row, self._heads, self._counts, self._next, self._row_of)
            self._used += len(features)
            self._rows.append(keyframe)
            self._sizes.append(len(features))
            self._features[keyframe] = features

    def forget(self, keyframe: int) -> None:
        """Drop the features of a keyframe whose view was not new."""
        del self._features[keyframe]

    def knows(self, keyframe: int) -> bool:
        """Return whether a keyframe's place would be recognised, by it or by one like it."""
        return keyframe in self._features or keyframe in self._known_by_others

    def features_of(self, keyframe: int) -> Features:
        """Return the features of a keyframe that was added."""
        return self._features[keyframe]

    def candidates(
        self, features: Features, count: int, without: Collection[int] = ()
    ) -> list[int]:
        """Return up to `count` keyframes that look most like these features, the best first."""
        words = np.empty((_TABLES, len(features)), np.int64)
        _write_words(features.descriptors, _SELECTED, words)
        with self._lock:
            votes = np.zeros(len(self._rows), np.float64)
            _vote(words, self._heads, self._counts, self._next, self._row_of, votes)
            rows, sizes = np.array(self._rows, np.int64), np.array(self._sizes)
        votes /= np.sqrt(sizes + _FEW_FEATURES)
        votes[np.isin(rows, list(without))] = 0.0
        best = np.argsort(-votes, kind='stable')[:count]
        return [int(rows[k]) for k in best if votes[k] > 0.0]

    def recognise(self, frame: RgbdFrame) -> list[Recognition]:
        """Return where a frame may have been taken, the likeliest first.

        A dozen features that agree are enough, as the depth has to agree with the map as well.
        """
        config = self._config
        features = extract(frame, self._camera, config.sensor, self_mask=config.self_mask)
        found = []
        for keyframe in self.candidates(features, _TRIED):
            then, alignment = self._features[keyframe], self.align(keyframe, features)
            if alignment is not None and not alignment.is_flat(then):
                found.append(recognition(keyframe, then, features, alignment))
        return sorted(found, key=lambda one: -len(one.points))[:_OFFERED]

    def align(self, keyframe: int, features: Features) -> Alignment | None:
        """Return where features are relative to a keyframe; None where that is not clear."""
        sensor, focal = self._config.sensor, self._camera.focal
        return align(self._features[keyframe], features, sensor, focal, seed=keyframe)

    def _reserve(self, more: int) -> None:
        """Make room for more features, at least doubling what there is."""
        needed = self._used + more
        if needed <= len(self._row_of):
            return
        size = max(needed, 2 * len(self._row_of), 1 << 14)
        grown_next, grown_rows = np.empty((_TABLES, size), np.int32), np.empty(size, np.int32)
        grown_next[:, : self._used] = self._next[:, : self._used]
        grown_rows[: self._used] = self._row_of[: self._used]
        self._next, self._row_of = grown_next, grown_rows


def recognition(
    keyframe: int, seen_then: Features, seen_now: Features, found: Alignment
) -> Recognition:
    """Return what an alignment of an image with a keyframe tells of the image's pose."""
    known = seen_then.depths_m[found.of_a] > 0.0
    now, points = seen_now[found.of_b[known]], seen_then.points[found.of_a[known]]
    return Recognition(keyframe, found.T_a_b, points, now.rays, now.depths_m)


@kernel
def _write_words(descriptors, selected, words):
    """Write the selected bits (T, B) of `descriptors` (N, 32) as numbers into `words` (T, N)."""
    for t in range(selected.shape[0]):
        for i in range(len(descriptors)):
            word = 0
            for k in range(selected.shape[1]):
                bit = selected[t, k]
                word = (word << 1) | ((descriptors[i, bit >> 3] >> (bit & 7)) & 1)
            words[t, i] = word


@kernel
def _file(words, used, row, heads, counts, following, row_of):
    """File the features with `words` (T, N), the first of which is number `used`, under them."""
    for i in range(words.shape[1]):
        row_of[used + i] = row
    for t in range(words.shape[0]):
        for i in range(words.shape[1]):
            word = words[t, i]
            following[t, used + i] = heads[t, word]
            heads[t, word] = used + i
            counts[t, word] += 1


@kernel
def _vote(words, heads, counts, following, row_of, votes):
    """Add to `votes` (R,) what each feature with the same word says for its keyframe's row."""
    for t in range(words.shape[0]):
        for i in range(words.shape[1]):
            word = words[t, i]
            count = counts[t, word]
            if count == 0 or count > _LONGEST:
                continue
            weight = np.log(1.0 + 8.0 * len(votes) / count)
            feature = heads[t, word]
            while feature >= 0:
                votes[row_of[feature]] += weight
                feature = following[t, feature]
