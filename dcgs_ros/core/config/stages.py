# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The settings of tracker and mapper: one frozen dataclass a stage, with the defaults."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..sensor import SensorNoise
from .presets import Ablation
from .schema import Stage, described, ranged


@dataclass(frozen=True)
class CloudConfig(Stage):
    """Sampling of a depth image into points with normals."""

    stride_px: int = ranged(
        10, 2, 64, 'Side of the square cells, pixels, that give one point of depth each.'
    )
    dilation_px: int = ranged(
        3, 1, 16, "Spacing, pixels, of the neighbours that give a point's scatter Q_i."
    )
    half_window: int = ranged(
        2, 1, 5, 'Neighbours are the black squares of a chessboard of 2 half_window + 1 a side.'
    )
    min_neighbours: float = ranged(
        0.6, 0, 1, 'Share of the neighbours with depth on the same surface that a point needs.'
    )
    min_view_cosine: float = ranged(
        0.17, 0, 0.99, 'Cosine between normal and ray below which a point is too grazing to use.'
    )


@dataclass(frozen=True)
class LandmarkConfig(Stage):
    """KLT corners and the image residual."""

    corners: int = ranged(300, 1, 5000, 'Corners that are kept alive.')
    min_distance_px: int = ranged(12, 2, 200, 'Smallest distance between corners, pixels.')
    quality: float = ranged(
        0.01, 1e-6, 1, 'Strength of the weakest corner that is taken, against the strongest.'
    )
    min_gradient: float = ranged(
        4.0,
        0,
        100,
        'Gradient in the weakest direction of a corner, grey levels a pixel, at least.',
    )
    window_px: int = ranged(13, 5, 63, 'Side of the window that KLT follows, pixels.')
    levels: int = ranged(3, 0, 6, "Levels of KLT's pyramid above the image itself.")
    back_check_px: float = ranged(
        1.0, 0.01, 100, 'Largest distance, pixels, of a corner followed forwards and back again.'
    )
    sigma_px: float = ranged(
        0.7, 0.01, 100, 'sigma_m: standard deviation of a followed corner, pixels (paper: 2).'
    )
    huber: float = ranged(
        2.0, 0.1, 1e6, 'delta of the Huber weight: residual, in standard deviations, at its bend.'
    )
    drop_chi2: float = ranged(
        50.0, 1, 1e12, 'Squared residual, in standard deviations, beyond which a landmark goes.'
    )
    anchor_radius_m: float = ranged(
        0.03, 1e-3, 1, 'Largest distance of a landmark to the Gaussian that carries it, metres.'
    )
    min_start: int = ranged(
        20, 6, 5000, 'Landmarks that suffice to start the registration from them.'
    )


@dataclass(frozen=True)
class RegistrationConfig(Stage):
    """Joint Levenberg-Marquardt on SE(3)."""

    radius_m: float = ranged(
        0.03, 2e-3, 1, 'r: radius of the association, metres, and its ambiguity in D_i.'
    )
    guess_radius_m: float = ranged(
        0.12, 2e-3, 2, 'Radius of the first association, metres, where no landmarks help.'
    )
    footprint_px: float = ranged(
        1.0, 0.01, 100, 'p_d: lateral standard deviation of a depth sample, pixels.'
    )
    anchor_px: float = ranged(
        0.5, 0.01, 100, 'p: lateral standard deviation of a Gaussian, pixels where it was seen.'
    )
    min_normal_cosine: float = ranged(
        0.7, -1, 1, 'Smallest cosine between the normals of a point and its Gaussian.'
    )
    max_iterations: int = ranged(8, 1, 100, 'Iterations for one frame, at most.')
    tolerance_m: float = ranged(
        5e-4, 1e-9, 1, 'The iteration ends with a step that moves less than this, metres ...'
    )
    tolerance_rad: float = ranged(3e-4, 1e-9, 1, '... and turns less than this, radians.')
    min_pairs: int = ranged(
        100,
        6,
        1000000,
        'Pairs of point and Gaussian that a pose needs, or the frame is lost.',
    )
    degenerate_ratio: float = ranged(
        200.0,
        1,
        1e12,
        'Ratio of the largest to the smallest eigenvalue of a block of the Hessian (translation, '
        'rotation) from which on the scene does not fix that direction.',
    )


@dataclass(frozen=True)
class KeyframeConfig(Stage):
    """When the map grows, and how."""

    translation_m: float = ranged(
        0.08, 1e-6, 100, 'Way from the last keyframe that makes a new one, metres.'
    )
    rotation_rad: float = ranged(
        0.105, 1e-6, 3.2, 'Turn from the last keyframe that makes a new one, radians.'
    )
    overlap: float = ranged(
        0.85,
        0.01,
        1,
        'Share of points that the map explains below which a new one is made, against the share '
        'just after the last.',
    )
    landmarks: float = ranged(
        0.5, 0.01, 1, 'Share of the landmarks of the last keyframe below which a new one is made.'
    )
    min_landmarks: int = ranged(
        20, 1, 5000, 'With fewer of them at the last keyframe, losing them makes no new one.'
    )
    min_interval_s: float = ranged(
        0.4, 0, 60, 'Time from the last keyframe, seconds, before motion and overlap make another.'
    )
    max_turn_rad_s: float = ranged(
        1.2, 0.01, 100, 'Turn rate, radians a second, above which only need makes a keyframe.'
    )
    spawn_stride_px: int = ranged(
        5, 2, 64, 'Side of the square cells, pixels, in which a keyframe adds a Gaussian.'
    )
    spawn_min_m: float = ranged(
        0.015, 1e-4, 1, 'Smallest distance of new Gaussians on one surface, metres ...'
    )
    spawn_px: float = ranged(4.0, 0.1, 100, '... and as seen in the image, pixels.')


@dataclass(frozen=True)
class TimingConfig(Stage):
    """Colour and depth are not taken at the same instant."""

    colour_depth_offset_ms: float | None = ranged(
        None, -100, 100, 'True time of a depth image less its stamp, milliseconds; auto: estimate.'
    )
    prior_ms: float = ranged(
        15.0, 0.1, 100, 'Standard deviation of that offset before anything is seen, milliseconds.'
    )
    memory_s: float = ranged(
        10.0, 0.1, 1e4, 'Time after which the estimate of the offset forgets, seconds.'
    )


@dataclass(frozen=True)
class MappingConfig(Stage):
    """The mapper: which views it gets, where Gaussians come and go, how long it optimises."""

    view_interval: int = ranged(4, 1, 1000, 'Frames after which one is mapped, keyframe or not.')
    steps_per_frame: float = ranged(
        3.0, 0, 1000, 'Steps for each frame, in lockstep with the tracker.'
    )
    final_steps: int = ranged(2500, 0, 1000000, 'Steps after the last frame.')
    newest_share: float = ranged(
        0.2, 0, 1, 'Share of the steps that go to the view that had the fewest.'
    )
    coarse_share: float = ranged(
        0.5, 0, 1, 'Share of the steps at half resolution, before the last frame.'
    )
    ssim_weight: float = ranged(0.2, 0, 1, 'Weight of D-SSIM in the loss; the rest is L1.')
    depth_weight: float = ranged(0.03, 0, 100, 'Weight of the depth error in the loss, 1/metre.')
    exposure_share: float = ranged(
        0.6, 0, 1, "Share of a view's exposure that is taken out of it; the rest is the map's."
    )
    spawn_stride_px: int = ranged(
        6, 1, 64, 'Side of the square cells, pixels, in which a view adds a Gaussian.'
    )
    spawn_transmittance: float = ranged(
        0.3, 0, 1, 'Share of light passing through the map above which it lacks Gaussians there.'
    )
    spawn_scale: float = ranged(
        0.6, 0.1, 10, 'Sigma of a new Gaussian along its surface, against its spacing.'
    )
    spawn_flatness: float = ranged(
        0.15, 1e-3, 1, 'Sigma of a new Gaussian across its surface, against that along it.'
    )
    spawn_opacity: float = ranged(0.7, 0.01, 0.99, 'Opacity of a new Gaussian.')
    fill_opacity: float = ranged(
        0.7, 0.01, 0.99, "Opacity of one where depth is missing and a neighbour's is taken."
    )
    reach_sigmas: float = ranged(
        0.5, 0, 1e6, 'Way that a measured mean may be moved by, in sigmas of its depth.'
    )
    prune_interval: int = ranged(100, 1, 100000, 'Steps from one pruning to the next.')
    prune_opacity: float = ranged(0.02, 0, 1, 'Opacity below which a Gaussian is removed.')
    prune_weight: float = ranged(
        0.5,
        0,
        1e6,
        'A Gaussian that never weighed more than this in an image, pixels, is removed.',
    )
    prune_scale_m: float = ranged(
        0.5, 1e-3, 1e3, 'Largest sigma above which a Gaussian is removed, metres.'
    )
    trial_visits: int = ranged(60, 1, 100000, 'Steps before a Gaussian is judged by its weight.')
    max_gaussians: int = ranged(
        400000, 1000, 20000000, 'Gaussians in the map, at most; bounds its memory and time.'
    )
    image_memory_mb: float = ranged(
        300.0, 1, 1e6, 'Memory for views as they are, megabytes; beyond it they are compressed.'
    )
    seed: int = ranged(0, 0, 2**31, 'Seed of the order in which views are optimised.')


@dataclass(frozen=True)
class RatesConfig(Stage):
    """Learning rates of the mapper's Adam."""

    mean_m: float = ranged(8e-4, 0, 1, 'Learning rate of the means, metres a step.')
    log_scale: float = ranged(1e-2, 0, 1, 'Learning rate of the logarithms of the sigmas.')
    rotation: float = ranged(4e-3, 0, 1, "Learning rate of the rotations' quaternions.")
    opacity: float = ranged(4e-2, 0, 1, "Learning rate of the opacities' logits.")
    color: float = ranged(2e-2, 0, 1, 'Learning rate of the colours.')
    pose_m: float = ranged(6e-4, 0, 1, "Learning rate of the views' positions, metres a step.")
    pose_rad: float = ranged(3e-4, 0, 1, "Learning rate of the views' rotations, radians a step.")
    exposure: float = ranged(
        0.3, 0, 1, 'Share of the way to the fitted exposure, every fourth visit of a view.'
    )
    final: float = ranged(0.1, 0, 1, 'Share of all these rates that the final steps end with.')


@dataclass(frozen=True)
class Config(Stage):
    """All stages."""

    ablation: Ablation = described(  # noqa: RUF009  it does not see that this is a Literal
        'full',
        'What of the method is at work: both covariances with landmarks (full), without landmarks '
        '(sigma_t); one shared covariance (shared), that with landmarks (shared_klt).',
    )
    shared_klt_weight: float = ranged(
        1.0, 0, 1e6, 'w: weight of the image residual in ablation shared_klt.'
    )
    threads: int | None = ranged(
        None, 1, 1024, 'Threads of the kernels; auto: one fewer than there are cores.'
    )
    sensor: SensorNoise = field(default_factory=SensorNoise)
    cloud: CloudConfig = field(default_factory=CloudConfig)
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    timing: TimingConfig = field(default_factory=TimingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    rates: RatesConfig = field(default_factory=RatesConfig)
