# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The base class of every error the package raises; modules add subclasses of it."""


class DcgsError(Exception):
    """An error that the user can act on; its message contains the numbers."""


class FrameError(DcgsError):
    """One frame cannot be used; the rest of the sequence can."""
