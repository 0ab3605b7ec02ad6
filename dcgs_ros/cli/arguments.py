# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What each verb can be told; nothing heavy is imported here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from ..core.errors import DcgsError

Source = Annotated[Positional[str], arg(metavar='SOURCE')]
OptionalFile = Annotated[Path | None, arg(metavar='FILE')]
OptionalText = Annotated[str | None, arg(metavar='TEXT')]


class UsageError(DcgsError):
    """An argument that makes no sense."""


@dataclass(frozen=True)
class RunArguments:
    """Track a sequence and write its trajectory, a report and a plot into a new folder."""

    source: Source
    """A dataset's folder in TUM layout, or synthetic:room|plane|zigzag, to which may be added
    ?frames=300&seed=0&sensor=kinect|d435i|ideal&speed=1."""

    out: Annotated[Path | None, arg(metavar='DIR')] = None
    """Folder to write, new or empty; by default runs/NAME-N with the first N that is free."""

    config: OptionalFile = None
    """YAML file of settings, plain or a ROS 2 parameter file; above the sensor's own."""

    settings: Annotated[
        tuple[tuple[str, ...], ...],
        arg(name='set', metavar='STAGE.FIELD=VALUE ...'),
        UseAppendAction,
    ] = ()
    """Settings one by one, above all others: --set keyframes.translation_m=0.1 threads=1."""

    ablation: Annotated[str | None, arg(metavar='full|sigma_t|shared|shared_klt')] = None
    """Both covariances with landmarks; without landmarks; one shared covariance; that with
    landmarks. By default what --config says, else full."""

    mapping: bool = True
    """There is no mapper yet: every run only tracks, with --no-mapping or without."""

    max_frames: Annotated[int | None, arg(metavar='N')] = None
    """Stop after N frames."""

    groundtruth: OptionalFile = None
    """Trajectory to compare with, in TUM's format; by default the dataset's own."""

    camera: Annotated[str | None, arg(metavar='PRESET|fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]')] = None
    """fr1, fr2, fr3, d435i, or intrinsics in pixels; by default told by the folder's name."""


@dataclass(frozen=True)
class EvaluateArguments:
    """Compare a trajectory with the true one: ATE after rigid alignment, RPE over 1 s."""

    trajectory: Annotated[Positional[Path], arg(metavar='TRAJECTORY')]
    """The estimate: `stamp tx ty tz qx qy qz qw` a line (TUM's format)."""

    groundtruth: Annotated[Positional[Path], arg(metavar='GROUNDTRUTH')]
    """The truth, likewise; poses within 20 ms of each other are compared."""

    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class InfoArguments:
    """Describe a sequence: its camera, its timing, and what its first frames hold."""

    source: Source
    """A dataset's folder in TUM layout, or a synthetic:... address, as for run."""

    camera: Annotated[str | None, arg(metavar='PRESET|fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]')] = None
    """fr1, fr2, fr3, d435i, or intrinsics in pixels; by default told by the folder's name."""
