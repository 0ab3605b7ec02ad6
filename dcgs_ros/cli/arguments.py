# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The arguments of each verb, and their `--help`; nothing heavy is imported here."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from tyro.conf import Positional, UseAppendAction, arg

from ..core.config.presets import Ablation, Quality, RegistrationChoice
from ..core.errors import DcgsError
from ..datasets.options import SourceOptions

OutputFormat = Literal['mcap', 'sqlite3', 'tum']


def _optional(metavar: str, help: str | None = None) -> Any:
    """Describe an argument that is None by default: its help text says what None means."""
    return arg(metavar=metavar, help=help, help_behavior_hint='')


def _choices(literal: Any) -> str:
    """Return the metavar of a Literal, as tyro writes it."""
    return f'{{{",".join(get_args(literal))}}}'


Source = Annotated[
    Positional[str],
    arg(
        metavar='SOURCE',
        help='The sequence: a TUM, Bonn, ScanNet, Replica, 7-Scenes, ICL-NUIM or Stray Scanner '
        'folder, a .sens file, or a folder with a dcgs.yaml; a rosbag2 folder, .mcap, .db3 or '
        'ROS 1 .bag, optionally with ?color=TOPIC&depth=TOPIC; any of these with '
        '?depth_per_metre=1000 ...; or synthetic:room|plane|zigzag|desk|corridor|'
        'ring, optionally with ?frames=300&seed=0&sensor=kinect|d435i|ideal|d435i_measured|'
        'kinect_measured&speed=1&light=1&motion=wheeled|handheld. See docs/datasets.md.',
    ),
]
Camera = Annotated[
    str | None,
    _optional(
        'PRESET|fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]',
        'Camera of the sequence: fr1, fr2, fr3, bonn, d435i, d435i_848, d435i_1280, scannet, '
        'replica, 7scenes or icl_nuim, or intrinsics in pixels. By default taken from the '
        'sequence.',
    ),
]
MaxFrames = Annotated[int | None, _optional('N', 'Stop after N frames. By default use all.')]
GroundTruth = Annotated[
    Path | None,
    _optional('FILE', "Ground truth in TUM's format. By default the sequence's own, if any."),
]


def _option(name: str, metavar: str) -> Any:
    """Describe an option of the source by its own documentation."""
    return _optional(metavar, SourceOptions.__dataclass_fields__[name].metadata['doc'])


@dataclass(frozen=True, kw_only=True)
class _WithOptions:
    """The options of a source, as flags."""

    depth_per_metre: Annotated[float | None, _option('depth_per_metre', 'N')] = None

    sync_slop_s: Annotated[float | None, _option('sync_slop_s', 'S')] = None

    rate_hz: Annotated[float | None, _option('rate_hz', 'HZ')] = None

    depth_registration: Annotated[
        RegistrationChoice, _option('depth_registration', _choices(RegistrationChoice))
    ] = 'auto'

    @property
    def options(self) -> SourceOptions:
        """The options; raises `ConfigError` for a value out of range."""
        return SourceOptions(**{f.name: getattr(self, f.name) for f in fields(SourceOptions)})


class UsageError(DcgsError):
    """Arguments that do not fit together or are out of range."""


@dataclass(frozen=True)
class RunArguments(_WithOptions):
    """Track and map a sequence. Writes trajectory, map, report and plots to a new folder."""

    source: Source

    out: Annotated[Path | None, _optional('DIR')] = None
    """Output folder, new or empty. By default runs/NAME-1, or the next number that is free."""

    config: Annotated[
        Path | None,
        _optional(
            'FILE',
            "YAML file of settings, plain or as ROS 2 parameters. Overrides the sensor's noise "
            'model, --quality and --online.',
        ),
    ] = None

    settings: Annotated[
        tuple[tuple[str, ...], ...],
        arg(
            name='set',
            metavar='STAGE.FIELD=VALUE ...',
            help='Single settings, e.g. --set keyframes.translation_m=0.1 threads=1. Overrides '
            'everything else.',
        ),
        UseAppendAction,
    ] = ()

    ablation: Annotated[
        Ablation | None,
        _optional(
            _choices(Ablation),
            'Parts of the method to use. full: separate tracking and rendering covariances, and '
            'landmarks. sigma_t: the same without landmarks. shared: one covariance for both, '
            'without landmarks. shared_klt: one covariance, with landmarks. By default full, '
            'unless --config says otherwise.',
        ),
    ] = None

    mapping: bool = True
    """Build a map. With --no-mapping the camera is only tracked."""

    map: Annotated[Path | None, _optional('FILE')] = None
    """A map.dcgs to begin in: the camera is looked for in it, and the map is extended by this
    session. FILE stays as it is; the map of both sessions goes to the output folder."""

    localize: bool = False
    """Only track the camera in the map of --map, and leave the map as it is."""

    loops: bool = True
    """Recognise places and close loops. With --no-loops no pose is corrected later, as in the
    paper."""

    online: Annotated[
        bool,
        arg(
            help='Play the sequence at its recorded pace, with the mapper in its own thread. '
            'Frames that arrive while the tracker is busy are dropped, so results vary from run '
            'to run.'
        ),
    ] = False

    quality: Annotated[
        Quality,
        arg(
            help='Effort of the mapper: optimisation steps per frame and after the last frame. '
            'high also uses more Gaussians and views.'
        ),
    ] = 'default'

    render_every: Annotated[int, arg(metavar='N')] = 5
    """After the run, compare renderings with the images of every Nth frame. 0: of none."""

    max_frames: MaxFrames = None

    groundtruth: GroundTruth = None

    camera: Camera = None

    asked_s: float = field(init=False, default_factory=time.perf_counter)  # not an option


@dataclass(frozen=True)
class EvaluateArguments:
    """Compare a trajectory with ground truth, and a run's map with its images.

    Prints ATE (after rigid alignment), RPE over 1 s, silent frames (state ok, but wrong by more
    than 10 cm or 15 claimed sigma over the last second), and PSNR, SSIM and LPIPS of the map.
    """

    estimate: Annotated[Positional[Path], arg(metavar='RUN|TRAJECTORY')]
    """Folder of a run, or a trajectory file in TUM's format: stamp tx ty tz qx qy qz qw."""

    groundtruth: Annotated[
        Positional[Path | None],
        _optional(
            '[GROUNDTRUTH]',
            "Ground truth in TUM's format; poses within 20 ms of each other are compared. "
            "Required for a trajectory file. For a run, by default the sequence's own.",
        ),
    ] = None

    source: Annotated[str | None, _optional('SOURCE')] = None
    """The run's sequence, if it has moved. By default the one that its report names."""

    camera: Annotated[str | None, _optional('PRESET|fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]')] = None
    """Camera of the sequence. By default the same as in the run."""

    render_every: Annotated[int, arg(metavar='N')] = 1
    """Compare renderings with the images of every Nth frame. 0: of none."""

    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class RenderArguments:
    """Render a map along a trajectory, as images or as a video."""

    map: Annotated[Positional[Path], arg(metavar='MAP')]
    """A run's map.dcgs, or a 3DGS .ply or .spz, which need --camera."""

    trajectory: Annotated[
        Path,
        arg(
            metavar='FILE',
            help="Poses in TUM's format. Between the first and the last keyframe of a map.dcgs "
            'they get the corrections that the mapper made to its keyframes.',
        ),
    ]

    out: Annotated[Path | None, _optional('DIR|VIDEO')] = None
    """New folder for numbered PNGs, or a video file (.mp4, .avi). By default runs/MAP-1, ..."""

    camera: Annotated[str | None, _optional('PRESET|fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]')] = None
    """Camera to render with, without distortion. By default the map's."""

    size: Annotated[str | None, _optional('WIDTHxHEIGHT')] = None
    """Size of the images in pixels. Required if --camera gives numbers."""

    depth: bool = False
    """Write depth too, as 16-bit PNGs in millimetres; 0 where nothing is seen."""


@dataclass(frozen=True)
class InfoArguments(_WithOptions):
    """Describe a sequence: its camera, its timing, and the content of its first frames; or a map.

    Of a map.dcgs: its size, Gaussians, keyframes, sessions and extent, and whether it is whole.
    """

    source: Source

    camera: Camera = None


@dataclass(frozen=True)
class GridArguments:
    """Write the occupancy grid of a map as nav2's map_server reads it: a YAML file and a PGM."""

    map: Annotated[Positional[Path], arg(metavar='MAP')]
    """A map.dcgs."""

    dest: Annotated[Positional[Path], arg(metavar='DEST.yaml')]
    """New file; the image is written beside it."""

    camera_height: Annotated[
        float | None,
        _optional(
            'M',
            'Height of the first camera above the floor, metres, for maps of `dcgs run`, whose '
            "world is that camera. By default the world's z axis points up from the floor, as in "
            'maps of the nodes with a base_frame on the floor.',
        ),
    ] = None

    camera_pitch: Annotated[float, arg(metavar='DEG')] = 0.0
    """With --camera-height: by how much that camera looked up, degrees; down is negative."""

    settings: Annotated[
        tuple[tuple[str, ...], ...],
        arg(
            name='set',
            metavar='FIELD=VALUE ...',
            help='Settings of the grid, e.g. --set resolution_m=0.1 max_height_m=0.6.',
        ),
        UseAppendAction,
    ] = ()

    @property
    def overrides(self) -> dict[str, str]:
        """The settings by name; raises `UsageError` for a text without '='."""
        texts = [text for group in self.settings for text in group]
        for text in texts:
            if '=' not in text:
                raise UsageError(f'--set {text}: not FIELD=VALUE')
        return {name: value for name, _, value in (text.partition('=') for text in texts)}


@dataclass(frozen=True)
class ConvertArguments(_WithOptions):
    """Convert a sequence to a rosbag2 with a RealSense's topics or to a TUM folder, or a map.

    A map (.dcgs, .ply, .spz) becomes a 3DGS .ply or .spz, as DEST ends. The summary at the end
    names what the format could not hold. Ground truth and IMU data of a rosbag2 are cut to the
    time of the frames. Stopped early, nothing is written.
    """

    source: Source

    dest: Annotated[Positional[Path], arg(metavar='DEST')]
    """Output folder, new or empty; of a map, a new file."""

    format: Annotated[
        OutputFormat | None,
        _optional(
            _choices(OutputFormat),
            'A rosbag2 in mcap or sqlite3 storage, or a TUM folder. By default sqlite3 if DEST '
            'ends with .db3, tum if it ends with .tum, else mcap.',
        ),
    ] = None

    compress: bool = False
    """Write CompressedImage: colour as JPEG (quality 95), depth as PNG in whole millimetres."""

    zstd: bool = False
    """Compress the rosbag2 without loss: chunks of an mcap, messages of a sqlite3."""

    camera: Camera = None

    groundtruth: GroundTruth = None

    max_frames: MaxFrames = None
