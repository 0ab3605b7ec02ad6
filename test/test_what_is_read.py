# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The table 'What is read' in docs/datasets.md says what the code reads.

`python test/test_what_is_read.py` writes it anew.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from dcgs_ros.datasets.bag.source import LAYOUT
from dcgs_ros.datasets.open import FORMATS
from dcgs_ros.io import ros_images
from dcgs_ros.io.images.encodings import COLOR_ENCODINGS
from dcgs_ros.io.images.transports import CODECS, COLOR_TRANSPORTS, DEPTH_TRANSPORTS

DOCS = Path(__file__).resolve().parents[1] / 'docs' / 'datasets.md'
HEAD = '| what | read |\n| --- | --- |\n'
TABLE = re.compile(rf'(?<=\n){re.escape(HEAD)}(?:\|.*\n)+')
ROWS: dict[str, tuple[Iterable[str], str]] = {  # names from the code, and what they leave unsaid
    'colour (Image)': (COLOR_ENCODINGS, '8UC and 16UC in the order of OpenCV, blue first'),
    'depth (Image)': (ros_images.DEPTH_ENCODINGS, '16 bits in mm, 32FC1 in m'),
    'transports of colour': (COLOR_TRANSPORTS, 'in bags and by `node.color_transport`'),
    'transports of depth': (DEPTH_TRANSPORTS, 'in bags and by `node.depth_transport`'),
    'compressed colour': (CODECS['colour'], 'with the colours of the file; Bayer mosaics too'),
    'compressed depth': (CODECS['depth'], '16UC1, or 32FC1 as inverse depth'),
    'lenses (CameraInfo)': (
        [*filter(None, ros_images._LENS_MODELS), *ros_images._FISHEYE_MODELS],
        f'up to {ros_images._MAX_COEFFICIENTS} coefficients; any where all is zero',
    ),
    'sizes': ((), f'16 to {ros_images._MAX_SIDE} pixels a side'),
    'files and folders': ([*(f.layout for f in FORMATS), LAYOUT], 'see above and below'),
}


def table() -> str:
    lines = []
    for what, (names, remark) in ROWS.items():
        plain = what == 'files and folders'
        listed = '; '.join(names) if plain else ', '.join(f'`{name}`' for name in names)
        listed = listed.replace(' (see docs/datasets.md)', '')
        lines.append(f'| {what} | {"; ".join(filter(None, [listed, remark]))} |\n')
    return HEAD + ''.join(lines)


def test_the_table_says_what_the_code_reads() -> None:
    found = TABLE.search(DOCS.read_text())
    assert found is not None
    assert found[0] == table()


if __name__ == '__main__':
    DOCS.write_text(TABLE.sub(lambda _: table(), DOCS.read_text()))
