# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`python -m dcgs_ros.cli` is `dcgs`."""

import sys

from .main import main

if __name__ == '__main__':
    sys.exit(main())
