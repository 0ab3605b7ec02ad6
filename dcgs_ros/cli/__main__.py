# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The `dcgs` command as `python -m dcgs_ros.cli`."""

import sys

from .main import main

if __name__ == '__main__':
    sys.exit(main())
