# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Quality of service, and the settings of DDS and malloc that large messages need."""

from __future__ import annotations

import ctypes
import os
import platform
import sys
from pathlib import Path

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'  # Fast DDS 2.14 reads no other name
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
_KEPT_BYTES = 256 << 20
_MAPPED_BYTES = 32 << 20  # the largest that glibc accepts

RELIABLE = QoSProfile(depth=32, reliability=ReliabilityPolicy.RELIABLE)


def sensor_qos(reliability: str, depth: int = 5) -> QoSProfile:
    """Return the profile for images, 'best_effort' or 'reliable', with a short queue."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy[reliability.upper()])


def latched(depth: int) -> QoSProfile:
    """Return a reliable profile with which late subscribers get the last `depth` messages."""
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def prepare() -> None:
    """Let DDS carry whole images, and malloc reuse their memory; call it before `rclpy.init`.

    By default Fast DDS drops most images of a camera, since its shared memory is smaller than one.
    A profile that the environment names already is kept.
    """
    profiles = profiles_file()
    if profiles is not None:
        os.environ.setdefault(_PROFILES, str(profiles))
    if platform.libc_ver()[0] == 'glibc':
        # Otherwise each image's memory is returned and requested again: 2 ms of page faults.
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_THRESHOLD, _MAPPED_BYTES)
        libc.mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)


def profiles_file() -> Path | None:
    """Return the package's Fast DDS profile: of the sources, or where colcon or pip put it."""
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    shares = [Path(prefix, 'share', 'dcgs_ros') for prefix in prefixes if prefix]
    for folder in (Path(__file__).resolve().parents[2], *shares):
        path = folder / 'config' / 'fastdds.xml'
        if path.is_file():
            return path
    return None
