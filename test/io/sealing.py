# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Files without the digest that would hide what else is wrong with them."""

from __future__ import annotations

import io
import re
import zipfile

from dcgs_ros.io.archive import VERSION

_VERSION = f'"version": {VERSION}'.encode()


def unsealed_zip(data: bytes) -> bytes:
    """Return an archive as version 1, which has no digest."""
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(file, 'w') as new:
        for name in old.namelist():
            content = old.read(name)
            if name == 'metadata.json':
                content = content.replace(_VERSION, b'"version": 1')
            new.writestr(zipfile.ZipInfo(name), content)
    return file.getvalue()


def unsealed_ply(data: bytes) -> bytes:
    """Return a PLY without its comment."""
    return re.sub(rb'comment [^\n]*\n', b'', data, count=1)
