# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs info`: describe a sequence without tracking it, or a map."""

from __future__ import annotations

from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np

from ..core.frame import RgbdFrame
from ..core.trajectory import Trajectory
from ..datasets.bag.source import BagSource
from ..datasets.open import open_source
from ..datasets.prefetch import prefetch
from ..datasets.source import BadFrame, RobotSource, Source
from ..datasets.undescribed.source import UndescribedError
from ..evaluation.depth_range import DepthSurvey
from .arguments import InfoArguments, UsageError
from .map_info import MAP_SUFFIX, camera_text, describe_map, sensor_text
from .tables import Row, table

_SAMPLE = 60  # frames read, from the first
_NOWHERE = 'recorded; not used, since it is not known where it is'


def execute(arguments: InfoArguments) -> int:
    """Print what the files and the first frames say, or a dcgs.yaml that would read them."""
    if arguments.source.endswith(MAP_SUFFIX):
        if arguments != InfoArguments(arguments.source):
            raise UsageError(f'{arguments.source}: the options are for sequences, not for maps')
        return describe_map(Path(arguments.source))
    try:
        source = open_source(arguments.source, arguments.camera, None, arguments.options)
    except UndescribedError as error:
        print(f'{error}\n\n{error.proposal}', end='')
        return 0
    frames, bad = _sample(source)
    rows = [
        ('frames', f'{len(source)}; the following is from the first {len(frames) + len(bad)}'),
        *_timing_rows(frames, len(source)),
        *_recording_rows(source),
        ('camera', camera_text(source.camera)),
        ('sensor', sensor_text(source.sensor)),
        ('depth unit', _unit(source.depth_per_metre)),
        *_depth_rows(frames, source),
        ('ground truth', _truth(source.groundtruth)),
        *_sensor_rows(source),
        *[('note', note) for note in source.notes],
        ('bad frames', f'{len(bad)} in the sample'),
        *[('', f'{item.name}: {item.reason}') for item in bad],
    ]
    print(table(source.name, rows))
    return 0


def _sample(source: Source) -> tuple[list[RgbdFrame], list[BadFrame]]:
    """Read the first frames; return the good and the bad ones."""
    with closing(prefetch(islice(source, _SAMPLE))) as items:
        sample = list(items)
    frames = [item for item in sample if isinstance(item, RgbdFrame)]
    return frames, [item for item in sample if isinstance(item, BadFrame)]


def _timing_rows(frames: list[RgbdFrame], total: int) -> list[Row]:
    """Return the rate from the median interval, and the duration estimated from it."""
    if len(frames) < 2:
        return []
    intervals_s = 1e-9 * np.diff([frame.stamp_ns for frame in frames])
    interval_s = float(np.median(intervals_s))
    lags_ms = 1e-6 * np.array([frame.depth_stamp_ns - frame.stamp_ns for frame in frames])
    low, high = np.percentile(lags_ms, [5, 95])
    return [
        ('rate', f'{1 / interval_s:.1f} Hz; longest gap {1e3 * intervals_s.max():.0f} ms'),
        ('duration', f'about {(total - 1) * interval_s:.1f} s at this rate'),
        (
            'depth stamp',
            f"{np.median(lags_ms):+.1f} ms from colour's (median; 5-95 %: "
            f'{low:+.1f} to {high:+.1f})',
        ),
    ]


def _recording_rows(source: Source) -> list[Row]:
    """Return the topics chosen of a recording, and how its depth is registered to colour."""
    if not isinstance(source, BagSource):
        return []
    recorded = source.recorded
    return [
        ('topics', f'{recorded.topics.color}, {recorded.topics.depth}'),
        ('registered', recorded.registration.reason),
    ]


def _sensor_rows(source: Source) -> list[Row]:
    """Return which sensors there are beside the camera, and whether it is known where."""
    robot = source if isinstance(source, RobotSource) else None
    rows = [('imu', 'none')]
    if next(source.imu(), None) is not None:
        known = robot is not None and robot.T_cam_imu is not None
        rows = [('imu', 'for --set priors.gyro=true' if known else _NOWHERE)]
    if robot is not None and next(robot.odometry(), None) is not None:
        known = robot.T_base_cam is not None
        rows.append(('odometry', 'for --set priors.wheels=true' if known else _NOWHERE))
    return rows


def _unit(per_metre: float | None) -> str:
    if per_metre is None:
        return 'made in metres'
    return f'{per_metre:g} per metre (--depth-per-metre)'


def _depth_rows(frames: list[RgbdFrame], source: Source) -> list[Row]:
    if not frames:
        return []
    sensor, survey = source.sensor, DepthSurvey()
    for frame in frames:
        survey.add(frame)
    warning = survey.warning(sensor, source.depth_per_metre)
    depths = np.concatenate([frame.depth_m[::4, ::4].ravel() for frame in frames])
    measured = depths[depths > 0]
    usable = (measured >= sensor.depth_min_m) & (measured <= sensor.depth_max_m)
    low, median, high = np.percentile(measured, [5, 50, 95])
    return [
        (
            'depth',
            f'{100 * len(measured) / len(depths):.0f} % of the pixels, '
            f"{100 * usable.sum() / len(depths):.0f} % in the sensor's range",
        ),
        ('depth range', f'{low:.2f} to {high:.2f} m (5-95 %), median {median:.2f}'),
        *([] if warning is None else [('warning', warning)]),
    ]


def _truth(truth: Trajectory | None) -> str:
    if truth is None:
        return 'none'
    way_m = np.linalg.norm(np.diff(truth.T_world_cam[:, :3, 3], axis=0), axis=1).sum()
    seconds = (truth.stamps_ns[-1] - truth.stamps_ns[0]) * 1e-9
    return f'{len(truth)} poses, {seconds:.1f} s, {way_m:.2f} m'
