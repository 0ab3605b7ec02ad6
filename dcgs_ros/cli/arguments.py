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
Camera = Annotated[str | None, arg(metavar='PRESET|fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]')]


class UsageError(DcgsError):
    """An argument that makes no sense."""


@dataclass(frozen=True)
class RunArguments:
    """Track and map a sequence; write trajectory, map, report and pictures into a new folder."""

    source: Source
    """A folder of TUM, Bonn, ScanNet (or its .sens), Replica, 7-Scenes or ICL-NUIM, or with a
    dcgs.yaml; a rosbag2 folder, .mcap, .db3 or .bag, to which ?color=TOPIC&depth=TOPIC may be
    added; or synthetic:room|plane|zigzag[?frames=300&seed=0&sensor=kinect|d435i|ideal&speed=1].
    docs/datasets.md has all."""

    out: Annotated[Path | None, arg(metavar='DIR')] = None
    """Folder to write, new or empty; by default runs/NAME-N with the first N that is free."""

    config: OptionalFile = None
    """YAML file of settings, plain or a ROS 2 parameter file; above --quality and the sensor's
    own."""

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
    """Without it the run only tracks, and writes no map."""

    online: bool = False
    """Frames come at the sequence's own pace, and the mapper runs free beside the tracker; a frame
    that a newer one overtakes before the tracker is free is dropped. Not reproducible."""

    quality: Annotated[str, arg(metavar='draft|default|high')] = 'default'
    """How long the mapper optimises: its steps for each frame and after the last."""

    render_every: Annotated[int, arg(metavar='N')] = 5
    """Of every Nth frame the rendering is compared with the image at the end; 0: of none."""

    max_frames: Annotated[int | None, arg(metavar='N')] = None
    """Stop after N frames."""

    groundtruth: OptionalFile = None
    """Trajectory to compare with, in TUM's format; by default the dataset's own."""

    camera: Camera = None
    """A preset (fr1, fr2, fr3, bonn, d435i, d435i_848, d435i_1280, scannet, replica, 7scenes,
    icl_nuim), or intrinsics in pixels; by default what the sequence says."""


@dataclass(frozen=True)
class EvaluateArguments:
    """Compare a trajectory with the truth, and a run's map with the images it was made from.

    ATE is after rigid alignment, RPE over 1 s; the map is compared by PSNR, SSIM and LPIPS.
    """

    estimate: Annotated[Positional[Path], arg(metavar='RUN|TRAJECTORY')]
    """Folder of a run; or its trajectory alone: `stamp tx ty tz qx qy qz qw` a line (TUM's)."""

    groundtruth: Annotated[Positional[Path | None], arg(metavar='GROUNDTRUTH')] = None
    """The truth, likewise; poses within 20 ms of each other are compared. A run's source may have
    its own."""

    source: Annotated[str | None, arg(metavar='SOURCE')] = None
    """Where the run's images are; by default where they were."""

    camera: Camera = None
    """Of the source; by default as it was for the run."""

    render_every: Annotated[int, arg(metavar='N')] = 1
    """Of every Nth frame the rendering is compared with the image; 0: of none."""

    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class RenderArguments:
    """Show a map from the poses of a trajectory, as images or as a video."""

    map: Annotated[Positional[Path], arg(metavar='MAP')]
    """map.dcgs of a run, or a 3DGS .ply; a .ply knows no camera."""

    trajectory: Annotated[Path, arg(metavar='FILE')]
    """Poses in TUM's format. Between the map's keyframes they are corrected as the mapper
    corrected those."""

    out: Annotated[Path | None, arg(metavar='DIR|VIDEO')] = None
    """New folder for numbered PNGs, or a video ending with .mp4 or .avi; by default runs/MAP-N."""

    camera: Camera = None
    """Camera instead of the map's; without distortion."""

    size: Annotated[str | None, arg(metavar='WIDTHxHEIGHT')] = None
    """Of the images, in pixels, where --camera gives numbers."""

    depth: bool = False
    """Write depth too, as PNGs of 16 bits in millimetres; 0 where the map shows nothing."""


@dataclass(frozen=True)
class InfoArguments:
    """Describe a sequence: its camera, its timing, and what its first frames hold."""

    source: Source
    """A sequence in any format, as for run."""

    camera: Camera = None
    """A preset (fr1, fr2, fr3, bonn, d435i, d435i_848, d435i_1280, scannet, replica, 7scenes,
    icl_nuim), or intrinsics in pixels; by default what the sequence says."""


@dataclass(frozen=True)
class ConvertArguments:
    """Write a sequence as a rosbag2 with a RealSense's topics, or as a folder in TUM's layout.

    Stamps stay as they are, and so do colour and depth unless something else is said at the end.
    Of a trajectory or an IMU a rosbag2 has what was measured while the frames were. What does not
    come to an end leaves nothing behind.
    """

    source: Source
    """A sequence in any format, as for run."""

    dest: Annotated[Positional[Path], arg(metavar='DEST')]
    """Folder to write, new or empty."""

    format: Annotated[str | None, arg(metavar='mcap|sqlite3|tum')] = None
    """A rosbag2 in either storage, or a TUM folder; by default sqlite3 for a DEST that ends with
    .db3, tum for .tum, else mcap."""

    compress: bool = False
    """Colour as JPEG (quality 95) and depth as PNG of whole millimetres: CompressedImage."""

    zstd: bool = False
    """Compress the recording without loss: chunks of an mcap, messages of a sqlite3."""

    camera: Camera = None
    """Of the source, as for run."""

    groundtruth: OptionalFile = None
    """Trajectory to write along, in TUM's format; by default the dataset's own."""

    max_frames: Annotated[int | None, arg(metavar='N')] = None
    """Stop after N frames."""
