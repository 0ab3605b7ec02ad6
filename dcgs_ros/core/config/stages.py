# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The settings of tracker and mapper: one frozen dataclass for each stage, with the defaults."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..sensor import SensorNoise
from .outlines import polygons
from .presets import Ablation
from .schema import Stage, described, override, ranged

_PIXELS = 'pixels of 640x480 (scaled in smaller images)'


@dataclass(frozen=True)
class CloudConfig(Stage):
    """Sampling of points with normals from a depth image."""

    stride_px: int = ranged(
        10, 2, 64, f'Side of the square cells, {_PIXELS}, each of which gives one point.'
    )
    dilation_px: int = ranged(
        3, 1, 16, f"Spacing of the neighbours that give a point's scatter Q_i, {_PIXELS}."
    )
    half_window: int = ranged(
        2, 1, 5, 'Neighbours are every second pixel of a window of 2 half_window + 1 a side.'
    )
    min_neighbours: float = ranged(
        0.6, 0, 1, "Smallest share of a point's neighbours that have depth on the same surface."
    )
    min_view_cosine: float = ranged(
        0.17, 0, 0.99, "Smallest cosine of the angle between a point's normal and its ray."
    )


@dataclass(frozen=True)
class LandmarkConfig(Stage):
    """KLT corners and the image residual."""

    corners: int = ranged(300, 1, 5000, 'Largest number of corners that are tracked.')
    min_distance_px: int = ranged(12, 2, 200, f'Smallest distance between corners, {_PIXELS}.')
    min_gradient_sigmas: float = ranged(
        3.0,
        0,
        1000,
        'Smallest gradient in the weakest direction of a corner, per pixel, in standard '
        "deviations of the image's noise.",
    )
    window_px: int = ranged(13, 5, 63, 'Side of the window that KLT tracks, pixels.')
    levels: int = ranged(3, 0, 6, "Levels of KLT's image pyramid, besides the image itself.")
    slip_px: float = ranged(
        1.5,
        0.01,
        100,
        'Largest distance of a tracked corner from where the patch it was detected in fits, '
        'pixels.',
    )
    min_correlation: float = ranged(
        0.6, -1, 1, 'Smallest correlation of a tracked corner with the patch it was detected in.'
    )
    sigma_px: float = ranged(
        0.7, 0.01, 100, 'sigma_m: standard deviation of a tracked corner, pixels (paper: 2).'
    )
    huber: float = ranged(
        2.0, 0.1, 1e6, 'delta of the Huber loss, in standard deviations of the residual.'
    )
    drop_chi2: float = ranged(
        50.0,
        1,
        1e12,
        'Squared residual, in standard deviations, above which a landmark is dropped.',
    )
    anchor_radius_m: float = ranged(
        0.03,
        1e-3,
        1,
        'Largest distance of a landmark from the Gaussian that it is anchored to, metres.',
    )
    replenish: float = ranged(
        0.8, 0, 1, 'Share of the landmarks of the last detection below which more are detected.'
    )
    min_factors: int = ranged(
        10, 1, 5000, 'Smallest number of landmarks that a pose is estimated with.'
    )


@dataclass(frozen=True)
class RegistrationConfig(Stage):
    """Joint Levenberg-Marquardt on SE(3)."""

    radius_m: float = ranged(
        0.03, 2e-3, 1, 'r: radius of the association, and its uncertainty in D_i, metres.'
    )
    guess_radius_m: float = ranged(
        0.12, 2e-3, 2, 'Radius of the first association if there are too few landmarks, metres.'
    )
    footprint_px: float = ranged(
        1.0, 0.01, 100, 'p_d: lateral standard deviation of a depth sample, pixels.'
    )
    anchor_px: float = ranged(
        0.5,
        0.01,
        100,
        'p: lateral standard deviation of a Gaussian, pixels in the image that saw it.',
    )
    min_normal_cosine: float = ranged(
        0.7, -1, 1, 'Smallest cosine of the angle between the normals of a point and its Gaussian.'
    )
    max_iterations: int = ranged(8, 1, 100, 'Largest number of iterations for one frame.')
    tolerance_m: float = ranged(
        5e-4, 1e-9, 1, 'The iteration ends with a step that moves less than this, metres ...'
    )
    tolerance_rad: float = ranged(3e-4, 1e-9, 1, '... and turns less than this, radians.')
    min_pairs: int = ranged(
        100,
        6,
        1000000,
        'Smallest number of points matched with a Gaussian; with fewer the frame is lost.',
    )
    degenerate_m: float = ranged(
        0.03,
        1e-6,
        1,
        'Standard deviation of the position in its weakest direction above which the pose counts '
        'as degenerate, metres ...',
    )
    degenerate_rad: float = ranged(0.045, 1e-6, 1, '... and of the rotation, radians.')


@dataclass(frozen=True)
class KeyframeConfig(Stage):
    """When keyframes are made, and which Gaussians they add."""

    translation_m: float = ranged(
        0.08, 1e-6, 100, 'Distance from the last keyframe that makes a new one, metres.'
    )
    rotation_rad: float = ranged(
        0.105, 1e-6, 3.2, 'Rotation from the last keyframe that makes a new one, radians.'
    )
    overlap: float = ranged(
        0.85,
        0.01,
        1,
        'Share of points that the map explains, relative to the best share since the last '
        'keyframe, below which a new one is made.',
    )
    landmarks: float = ranged(
        0.5, 0.01, 1, 'Share of the landmarks of the last keyframe below which a new one is made.'
    )
    min_landmarks: int = ranged(
        20,
        1,
        5000,
        'With fewer landmarks at the last keyframe, losing them does not make a new one.',
    )
    min_interval_s: float = ranged(
        0.4,
        0,
        60,
        'Smallest time between keyframes, seconds, unless overlap or landmarks make one urgent.',
    )
    max_turn_rad_s: float = ranged(
        1.2,
        0.01,
        100,
        'Turn rate above which only an urgent keyframe is made, radians per second.',
    )
    new_submap_s: float | None = ranged(
        4.0,
        0.1,
        1e6,
        'Time for which a lost camera is looked for before a new sub-map begins, which is not '
        'joined to the map, seconds; auto: it is always looked for.',
    )
    spawn_stride_px: int = ranged(
        5,
        2,
        64,
        f'Side of the square cells, {_PIXELS}, in each of which a keyframe adds a Gaussian.',
    )
    spawn_min_m: float = ranged(
        0.015, 1e-4, 1, 'Smallest distance of new Gaussians from others on the surface, metres ...'
    )
    spawn_px: float = ranged(4.0, 0.1, 100, f'... and in the image, {_PIXELS}.')


@dataclass(frozen=True)
class TimingConfig(Stage):
    """Difference of time between colour and depth."""

    colour_depth_offset_ms: float | None = ranged(
        None,
        -100,
        100,
        'True time of a depth image minus its stamp, milliseconds; auto: estimated.',
    )
    prior_ms: float = ranged(
        15.0, 0.1, 100, 'Standard deviation of that offset before it is estimated, milliseconds.'
    )
    memory_s: float = ranged(
        10.0,
        0.1,
        1e4,
        'Time constant with which measurements of the offset are forgotten, seconds.',
    )


@dataclass(frozen=True)
class PriorsConfig(Stage):
    """Sensors beside the camera that tell its motion; they are off, so that images stand alone."""

    gyro: bool = described(False, "Whether the camera's rotation is predicted by a gyro.")
    gravity: bool = described(
        False, 'Whether roll and pitch are held from drifting by an IMU, whose gyro is used too.'
    )
    wheels: bool = described(False, "Whether the camera's motion is predicted by wheel odometry.")
    planar_m: float | None = ranged(
        None,
        1e-4,
        10,
        'Standard deviation of the height of a base that moves over a flat floor, metres; auto: '
        'it may climb.',
    )
    planar_deg: float = ranged(
        0.2, 0.01, 45, 'With planar_m: standard deviation of its roll and pitch, degrees.'
    )

    @property
    def needs_gyro(self) -> bool:
        """Whether a gyro is used: it carries on what the accelerometer tells of up."""
        return self.gyro or self.gravity


@dataclass(frozen=True)
class BackendConfig(Stage):
    """Recognition of places, and corrections of the keyframes' poses."""

    loops: bool = described(
        True, 'Whether places are recognised and loops closed; if not, no pose is corrected.'
    )


@dataclass(frozen=True)
class MappingConfig(Stage):
    """The mapper: its views, the Gaussians it adds and removes, and its optimisation."""

    view_interval: int = ranged(
        4, 1, 1000, 'Every so many frames one is given to the mapper, keyframe or not.'
    )
    steps_per_frame: float = ranged(
        3.0, 0, 1000, 'Optimisation steps for each frame, in lockstep with the tracker.'
    )
    final_steps: int = ranged(2500, 0, 1000000, 'Optimisation steps after the last frame.')
    newest_share: float = ranged(
        0.2, 0, 1, 'Share of the steps that optimise the view with the fewest steps so far.'
    )
    coarse_share: float = ranged(
        0.5, 0, 1, 'Share of the steps at half resolution, until the last frame.'
    )
    ssim_weight: float = ranged(0.2, 0, 1, 'Weight of D-SSIM in the loss; the rest is L1.')
    depth_weight: float = ranged(0.03, 0, 100, 'Weight of the depth error in the loss, 1/metre.')
    exposure_share: float = ranged(
        0.6,
        0,
        1,
        "Share of a view's fitted exposure that is applied; the map's colours take the rest.",
    )
    spawn_stride_px: int = ranged(
        6, 1, 64, 'Side of the square cells, pixels, in each of which a view may add a Gaussian.'
    )
    spawn_transmittance: float = ranged(
        0.3, 0, 1, 'Transmittance of the map above which a pixel lacks Gaussians.'
    )
    spawn_scale: float = ranged(
        0.6, 0.1, 10, 'Sigma of a new Gaussian along its surface, relative to the spacing.'
    )
    spawn_flatness: float = ranged(
        0.15, 1e-3, 1, 'Sigma of a new Gaussian across its surface, relative to that along it.'
    )
    spawn_opacity: float = ranged(0.7, 0.01, 0.99, 'Opacity of a new Gaussian.')
    fill_opacity: float = ranged(
        0.7,
        0.01,
        0.99,
        'Opacity of a new Gaussian whose depth is taken from a neighbouring pixel.',
    )
    reach_sigmas: float = ranged(
        0.5, 0, 1e6, 'Largest distance that a measured mean may move, in sigmas of its depth.'
    )
    prune_interval: int = ranged(
        100, 1, 100000, 'Optimisation steps from one pruning to the next.'
    )
    prune_opacity: float = ranged(0.02, 0, 1, 'Opacity below which a Gaussian is removed.')
    prune_weight: float = ranged(
        0.5,
        0,
        1e6,
        'Sum of blending weights, pixels, that a Gaussian needs in one image to be kept.',
    )
    prune_scale_m: float = ranged(
        0.5, 1e-3, 1e3, 'Sigma along the longest axis above which a Gaussian is removed, metres.'
    )
    trial_visits: int = ranged(
        60, 1, 100000, 'Optimisation steps before a Gaussian can be removed for its weight.'
    )
    max_gaussians: int = ranged(
        400000, 1000, 20000000, 'Largest number of Gaussians in the map; limits memory and time.'
    )
    image_memory_mb: float = ranged(
        300.0, 1, 1e6, 'Memory for the images of views, megabytes; beyond it they are compressed.'
    )
    seed: int = ranged(0, 0, 2**31, 'Seed of the order in which views are optimised.')


@dataclass(frozen=True)
class RatesConfig(Stage):
    """Learning rates of the mapper's Adam optimiser."""

    mean_m: float = ranged(8e-4, 0, 1, 'Learning rate of the means, metres per step.')
    log_scale: float = ranged(1e-2, 0, 1, 'Learning rate of the logarithms of the sigmas.')
    rotation: float = ranged(4e-3, 0, 1, "Learning rate of the rotations' quaternions.")
    opacity: float = ranged(4e-2, 0, 1, "Learning rate of the opacities' logits.")
    color: float = ranged(2e-2, 0, 1, 'Learning rate of the colours.')
    pose_m: float = ranged(6e-4, 0, 1, "Learning rate of the views' positions, metres per step.")
    pose_rad: float = ranged(
        3e-4, 0, 1, "Learning rate of the views' rotations, radians per step."
    )
    exposure: float = ranged(
        0.3, 0, 1, 'Share of the way to the fitted exposure, at every fourth visit of a view.'
    )
    final: float = ranged(0.1, 0, 1, 'Factor of all these rates at the end of the final steps.')


# Settings that follow the size of the image, and the least that each may be, pixels.
_DISTANCES = (
    ('cloud', 'stride_px', 3),
    ('cloud', 'dilation_px', 1),
    ('landmarks', 'min_distance_px', 5),
    ('keyframes', 'spawn_stride_px', 2),
    ('keyframes', 'spawn_px', 2),
)


@dataclass(frozen=True)
class Config(Stage):
    """The settings of all stages."""

    ablation: Ablation = described(  # noqa: RUF009  it does not see that this is a Literal
        'full',
        'Variant of the method: both covariances with landmarks (full) or without (sigma_t); one '
        'shared covariance without landmarks (shared) or with them (shared_klt).',
    )
    shared_klt_weight: float = ranged(
        1.0, 0, 1e6, 'w: weight of the image residual in ablation shared_klt.'
    )
    threads: int | None = ranged(
        None, 1, 1024, 'Threads of the kernels; auto: one less than the number of cores.'
    )
    self_mask: str = described(
        '',
        "Parts of the robot in the image, of which nothing is used: a polygon's corners as shares "
        'of width and height, such as [[0.3, 0.8], [0.7, 0.8], [0.7, 1], [0.3, 1]], or a list of '
        'polygons; empty: none.',
    )
    sensor: SensorNoise = field(default_factory=SensorNoise)
    cloud: CloudConfig = field(default_factory=CloudConfig)
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    timing: TimingConfig = field(default_factory=TimingConfig)
    priors: PriorsConfig = field(default_factory=PriorsConfig)
    backend: BackendConfig = field(default_factory=BackendConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    rates: RatesConfig = field(default_factory=RatesConfig)

    def __post_init__(self) -> None:
        """Check the ranges, and the polygons."""
        super().__post_init__()
        polygons(self.self_mask)

    def scaled_to(self, width: int, height: int) -> Config:
        """Return the settings for images of this size, in pixels.

        Distances between samples are meant for 640x480. In smaller images they shrink, so that
        the tracker has as many points, corners and Gaussians; in larger ones they stay. Standard
        deviations in pixels are those of measurements, whatever the size.
        """
        share = math.sqrt(width * height / (640 * 480))
        if share >= 1.0:
            return self
        changes = {
            f'{stage}.{name}': max(round(share * getattr(getattr(self, stage), name)), least)
            for stage, name, least in _DISTANCES
        }
        return override(self, changes)

    @property
    def uses_landmarks(self) -> bool:
        """Whether the ablation has an image residual."""
        return self.ablation in ('full', 'shared_klt')

    @property
    def shares_covariance(self) -> bool:
        """Whether the ablation registers with normalised covariances, not the tracker's own."""
        return self.ablation in ('shared', 'shared_klt')
