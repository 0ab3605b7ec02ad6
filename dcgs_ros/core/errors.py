# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The root of every error the package raises; each module adds one subclass."""


class DcgsError(Exception):
    """Something the user can act on; the message carries the numbers."""


class FrameError(DcgsError):
    """One frame cannot be used; the sequence around it can."""
