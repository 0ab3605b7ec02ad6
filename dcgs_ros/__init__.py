# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Dual Covariance Gaussian Splatting SLAM for ROS 2 and Python.

The names below are imported from their modules on first use, so that `import dcgs_ros` itself
loads neither numpy, OpenCV nor Numba.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .core.camera import PinholeCamera as PinholeCamera
    from .core.config.stages import Config as Config
    from .core.errors import DcgsError as DcgsError
    from .core.frame import RgbdFrame as RgbdFrame
    from .core.kernels.workers import Workers as Workers
    from .core.keyframe import Keyframe as Keyframe
    from .core.keyframe import MapUpdate as MapUpdate
    from .core.mapping.mapper import Mapper as Mapper
    from .core.render import make_renderer as make_renderer
    from .core.sensor import SensorNoise as SensorNoise
    from .core.slam import Lockstep as Lockstep
    from .core.tracking.result import TrackingState as TrackingState
    from .core.tracking.result import TrackResult as TrackResult
    from .core.tracking.tracker import Tracker as Tracker
    from .core.trajectory import Trajectory as Trajectory
    from .datasets.open import open_source as open_source
    from .evaluation.trajectory import absolute_trajectory_error as absolute_trajectory_error
    from .evaluation.trajectory import relative_pose_error as relative_pose_error
    from .io.map_archive import read_map as read_map
    from .io.map_archive import write_map as write_map
    from .io.ply import read_ply as read_ply
    from .io.ply import write_ply as write_ply
    from .io.trajectory import read_tum as read_tum
    from .io.trajectory import write_tum as write_tum

__version__ = '0.1.0'

# The module of each name; type checkers read the imports above instead, and a test compares them.
_HOMES = {
    'Config': 'core.config.stages',
    'DcgsError': 'core.errors',
    'Keyframe': 'core.keyframe',
    'Lockstep': 'core.slam',
    'MapUpdate': 'core.keyframe',
    'Mapper': 'core.mapping.mapper',
    'PinholeCamera': 'core.camera',
    'RgbdFrame': 'core.frame',
    'SensorNoise': 'core.sensor',
    'TrackResult': 'core.tracking.result',
    'Tracker': 'core.tracking.tracker',
    'TrackingState': 'core.tracking.result',
    'Trajectory': 'core.trajectory',
    'Workers': 'core.kernels.workers',
    'absolute_trajectory_error': 'evaluation.trajectory',
    'make_renderer': 'core.render',
    'open_source': 'datasets.open',
    'read_map': 'io.map_archive',
    'read_ply': 'io.ply',
    'read_tum': 'io.trajectory',
    'relative_pose_error': 'evaluation.trajectory',
    'write_map': 'io.map_archive',
    'write_ply': 'io.ply',
    'write_tum': 'io.trajectory',
}
__all__ = ['__version__', *_HOMES]


if not TYPE_CHECKING:  # with it every name would pass a type checker

    def __getattr__(name: str) -> Any:
        """Import a public name on first use (PEP 562)."""
        if name not in _HOMES:
            raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
        value = getattr(import_module(f'.{_HOMES[name]}', __name__), name)
        globals()[name] = value  # next time it is found without this function
        return value


def __dir__() -> list[str]:
    """Return the module's names, public ones included before their first use."""
    return sorted({*globals(), *__all__})
