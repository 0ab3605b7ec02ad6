# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The report follows from the record, and is strict JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.tracking.observability import Observability
from dcgs_ros.core.tracking.result import Reference, TrackingState, TrackResult
from dcgs_ros.core.tracking.visited import origin
from dcgs_ros.core.trajectory import Trajectory
from dcgs_ros.evaluation.rendering import Scores, ViewScores
from dcgs_ros.evaluation.report import (
    Accuracy,
    FinalMap,
    RunRecord,
    SkippedFrame,
    TrackedFrame,
    assess,
    assess_run,
    build_report,
    with_rendering,
)

FRAME_NS = 50_000_000
ROUNDING = 1e-9


def spectrum(kappa: float) -> Observability:
    return Observability(
        np.ones(6), np.eye(6)[0], kappa, 2 * kappa, 3 * kappa, 4 * kappa, 1e-3, 1e-3
    )


def tracked(
    index: int,
    state: TrackingState = TrackingState.OK,
    seconds: float = 0.01,
    kappa: float | None = None,
    keyframe: bool = False,
) -> TrackedFrame:
    """Return a frame of a camera that swings sideways."""
    T_world_cam = se3.exp(np.array([np.sin(0.3 * index), 0.1 * index, 0, 0, 0, 0.02 * index]))
    result = TrackResult(
        stamp_ns=index * FRAME_NS,
        T_cam_cam_at_depth=np.eye(4),
        T_world_cam=T_world_cam,
        covariance=np.eye(6),
        covariance_world=np.eye(6),
        state=state,
        observability=None if kappa is None else spectrum(kappa),
        points=100,
        inliers=90,
        landmarks=10,
        keyframe=keyframe,
        keyframes=(),
        colour_depth_offset_ms=0.1 * index,
    )
    return TrackedFrame(index, result, seconds, gaussians=1000 * index)


def a_record() -> RunRecord:
    record = RunRecord('room', 'full', wall_s=2.5, frames_s=0.5, interrupted=False)
    record.tracked = [
        tracked(0, seconds=0.04, keyframe=True),
        tracked(1, kappa=5.0),
        tracked(3, TrackingState.DEGENERATE, kappa=100.0, keyframe=True),
        tracked(4, TrackingState.LOST),
        tracked(5, kappa=7.0, seconds=0.02),
    ]
    record.skipped = [SkippedFrame(2, None, 'frame 3 of 6', 'cut off')]
    return record


def report_of(record: RunRecord, accuracy: Accuracy | None = None) -> dict[str, Any]:
    return build_report(record, accuracy or Accuracy(), '2 x CPU', 321.0, '1.2.3')


def test_frames_are_counted_once_each() -> None:
    report = report_of(a_record())
    assert report['frames'] == 6
    assert (report['tracked'], report['lost'], report['skipped']) == (4, 1, 1)
    assert report['degenerate'] == 1  # among the tracked
    assert report['keyframes'] == 2
    assert report['interrupted'] is False


def test_a_camera_that_is_found_again_is_tracked() -> None:
    record = a_record()
    record.tracked.append(tracked(6, TrackingState.RELOCALISED))
    report = report_of(record)
    assert (report['tracked'], report['lost']) == (5, 1)
    assert {name: state['frames'] for name, state in report['states'].items()} == {
        'ok': 3, 'degenerate': 1, 'lost': 1, 'relocalised': 1,
    }  # fmt: skip
    assert report['states']['lost']['longest_s'] == pytest.approx(FRAME_NS * 1e-9)
    assert sum(state['frames'] for state in report['states'].values()) == 6


def test_dropped_frames_are_skipped_ones() -> None:
    record = a_record()
    record.skipped.append(SkippedFrame(6, 6 * FRAME_NS, 'frame 7', 'overtaken', dropped=True))
    report = report_of(record)
    assert (report['frames'], report['skipped'], report['dropped']) == (7, 2, 1)


def test_the_report_holds_the_address_and_camera_of_the_source() -> None:
    record = RunRecord('room', 'full', '../data/room', 'fr1', tracked=[tracked(0)])
    assert report_of(record)['address'] == '../data/room'
    assert report_of(record)['camera'] == 'fr1'


def test_speed_is_frames_over_the_time_inside_track() -> None:
    report = report_of(a_record())
    speed = report['tracking']
    assert speed['fps_mean'] == pytest.approx(5 / 0.09)
    assert speed['ms_median'] == pytest.approx(10.0)
    assert speed['ms_median'] <= speed['ms_p95'] <= speed['ms_p99'] <= 40.0
    assert (report['wall_s'], report['frames_s']) == (2.5, 0.5)
    assert report['realtime_factor'] == pytest.approx(5 * FRAME_NS * 1e-9 / 0.5)


def test_kappas_are_medians_over_frames_that_have_them() -> None:
    assert report_of(a_record())['observability'] == {
        'kappa_median': 7.0,
        'kappa_without_radius_median': 14.0,
        'kappa_rotation_median': 21.0,
        'kappa_translation_median': 28.0,
    }


def test_map_and_offset_are_those_at_the_end() -> None:
    report = report_of(a_record())
    assert report['mapping'] == {'gaussians': 5000, 'iterations': 0, 'iterations_per_s': 0.0}
    assert report['timing'] == {'colour_depth_offset_ms': pytest.approx(0.5)}


def test_a_mapper_counts_its_own_gaussians_and_steps() -> None:
    record = a_record()
    record.gaussians, record.iterations, record.mapping_s = 700, 30, 1.5
    expected = {'gaussians': 700, 'iterations': 30, 'iterations_per_s': pytest.approx(20.0)}
    assert report_of(record)['mapping'] == expected


def test_rendering_is_null_until_views_are_scored() -> None:
    report = report_of(a_record())
    assert report['rendering'] is None
    assert with_rendering(report, [])['rendering'] is None
    masked = Scores(25.0, 0.9, None)
    view = ViewScores(24.0, 0.8, float('nan'), 0, True, None, masked, 0.01)
    scored = with_rendering(report, [view])
    assert scored['rendering']['psnr_db'] == 24.0
    assert scored['rendering']['lpips'] is None
    assert {key: scored[key] for key in scored if key != 'rendering'} == {
        key: report[key] for key in report if key != 'rendering'
    }
    json.dumps(scored, allow_nan=False)


def test_one_frame_and_no_truth_make_a_report_of_strict_json() -> None:
    record = RunRecord('room', 'full', tracked=[tracked(0)])
    report = report_of(record)
    assert report['ate'] is None
    assert report['rpe_1s'] is None
    assert report['observability']['kappa_median'] is None
    assert json.loads(json.dumps(report, allow_nan=False)) == report


def test_non_finite_values_become_null() -> None:
    record = a_record()
    record.tracked.append(tracked(6, kappa=float('inf')))
    record.tracked.append(tracked(7, kappa=float('inf')))
    record.tracked.append(tracked(8, kappa=float('nan')))
    record.wall_s = float('inf')
    report = report_of(record)
    assert report['observability']['kappa_median'] is None
    assert report['wall_s'] is None
    json.dumps(report, allow_nan=False)


def test_trajectories_hold_the_estimated_poses_and_the_keyframes() -> None:
    """The pose of a lost frame is no estimate."""
    record = a_record()
    estimate, keyframes = record.trajectory(), record.keyframes()
    assert estimate.stamps_ns.tolist() == [k * FRAME_NS for k in (0, 1, 3, 5)]
    assert keyframes.stamps_ns.tolist() == [0, 3 * FRAME_NS]
    np.testing.assert_array_equal(keyframes.T_world_cam, estimate.T_world_cam[[0, 2]])
    assert len(RunRecord('room', 'full').trajectory()) == 0


def test_a_clock_that_is_set_back_costs_no_trajectory() -> None:
    """Poses come in the order of their stamps; of a stamp that came twice the first one counts."""
    record = RunRecord('room', 'full')
    clock = (0, 1, 100, 2, 3, 1)  # frame 2 was an hour ahead, before frame 5 the clock was reset
    for index, ticks in enumerate(clock):
        frame = tracked(index, keyframe=index % 2 == 1)
        result = replace(frame.result, stamp_ns=ticks * FRAME_NS)
        record.tracked.append(replace(frame, result=result))
    estimate, keyframes = record.trajectory(), record.keyframes()
    assert (estimate.stamps_ns // FRAME_NS).tolist() == [0, 1, 2, 3, 100]
    for k, index in enumerate((0, 1, 3, 4, 2)):
        own = record.tracked[index].result.T_world_cam
        np.testing.assert_array_equal(estimate.T_world_cam[k], own)
    assert (keyframes.stamps_ns // FRAME_NS).tolist() == [1, 2]
    report = report_of(record)
    assert report['frames'] == report['tracked'] + report['lost'] + report['skipped'] == 6
    assert report['states']['ok']['frames'] == 6
    assert report['realtime_factor'] > 0


def referred(
    index: int,
    keyframe: int,
    motion: NDArray[np.float64],
    submap: int = 0,
    revision: int = 0,
    state: TrackingState = TrackingState.OK,
) -> TrackedFrame:
    """Return a frame that is `motion` off a keyframe, whose world has stepped by `STEP` since."""
    frame = tracked(index, state)
    before = np.eye(4) if revision == 0 else se3.inverse(STEP)
    reference = Reference(keyframe, motion, submap, keyframe, revision, before)
    T = (np.eye(4) if revision == 0 else STEP) @ frame.result.T_world_cam
    T[:3, 3] += origin(submap)
    return replace(frame, result=replace(frame.result, reference=reference, T_world_cam=T))


STEP = se3.exp(np.array([0.5, 0.0, 0.2, 0.0, 0.3, 0.0]))
ASIDE = se3.exp(np.array([0.1, 0.2, 0.3, 0.1, 0.0, 0.0]))


def a_closed_record() -> RunRecord:
    """Return a run whose second keyframe moved, and whose third is in a sub-map of its own."""
    poses = np.stack([np.eye(4), STEP, ASIDE, ASIDE])
    final = FinalMap(poses, poses[[0, 0, 2, 3]], np.array([0, 0, 1, 1], np.int32), [(0, 1)])
    record = RunRecord('room', 'full', final=final)
    record.tracked = [
        tracked(0), referred(1, 0, ASIDE), referred(2, 1, ASIDE, revision=1),
        referred(3, 1, np.eye(4), revision=2),
        referred(4, 1, np.eye(4), revision=2, state=TrackingState.LOST), referred(5, 2, ASIDE, 1),
    ]  # fmt: skip
    return record


def test_at_the_end_frames_are_where_their_keyframes_have_come_to_be() -> None:
    record = a_closed_record()
    optimized, mapped = record.optimized(), record.mapped()
    assert optimized is not None
    assert optimized.stamps_ns.tolist() == mapped.stamps_ns.tolist() == [
        k * FRAME_NS for k in (1, 2, 3)
    ]  # fmt: skip
    np.testing.assert_allclose(optimized.T_world_cam, [ASIDE, STEP @ ASIDE, STEP])
    np.testing.assert_allclose(mapped.T_world_cam, [ASIDE, ASIDE, np.eye(4)])
    np.testing.assert_allclose(record.loop_ends(), [[np.zeros(3), STEP[:3, 3]]])
    report = report_of(record)
    assert report['loops'] == {'closed': 1, 'corrections': 2, 'submaps': 2, 'seconds': 0.0}


def test_where_no_frame_has_a_keyframe_nothing_is_placed() -> None:
    record = a_closed_record()
    record.tracked = record.tracked[:1]
    optimized = record.optimized()
    assert optimized is not None and not len(optimized) and not len(record.mapped())


def test_without_a_back_end_only_what_was_known_live_is_told() -> None:
    record = a_record()
    assert record.optimized() is None and len(record.loop_ends()) == 0
    np.testing.assert_array_equal(record.mapped().T_world_cam, record.trajectory().T_world_cam)
    report = report_of(record)
    assert report['loops'] is None and report['optimized'] is None


def test_sub_maps_that_are_not_joined_are_told_apart() -> None:
    """The one with the most frames counts, at the place where it would begin if it were joined."""
    record = a_closed_record()
    assert record.trajectory().stamps_ns.tolist() == [k * FRAME_NS for k in (0, 1, 2, 3)]
    claims = record.claims()
    assert claims.submaps.tolist() == [0, 0, 0, 0, 0, 1] and claims.main_submap == 0
    aside = claims.trajectory(1)
    assert len(aside) == 1 and np.abs(aside.T_world_cam[:, :3, 3]).max() < 10.0
    record.tracked += [referred(k, 2, ASIDE, 1) for k in range(6, 12)]
    assert record.claims().main_submap == 1
    assert record.trajectory().stamps_ns.tolist() == [k * FRAME_NS for k in range(5, 12)]


def test_steps_of_the_world_are_not_motion() -> None:
    """A correction makes the pose step; what was tracked between is judged without the step."""
    steady = RunRecord('room', 'full', tracked=[tracked(k) for k in range(60)])
    stepped = RunRecord('room', 'full', tracked=[
        tracked(k) if k < 30 else referred(k, 0, np.eye(4), revision=1) for k in range(60)
    ])  # fmt: skip
    truth = steady.trajectory()
    for record in (steady, stepped):
        accuracy = assess_run(record, truth)
        assert accuracy.silent is not None and accuracy.nees is not None
        assert accuracy.silent.count == 0
        np.testing.assert_allclose(accuracy.nees.values, 0.0, atol=1e-9)
    uncorrected = stepped.claims().uncorrected
    np.testing.assert_allclose(uncorrected.T_world_cam, truth.T_world_cam, atol=1e-12)
    assert assess_run(stepped, truth).ate.rmse_cm > 1.0  # type: ignore[union-attr]


def test_the_errors_at_the_end_are_beside_those_that_were_live() -> None:
    record = RunRecord('room', 'full', tracked=[referred(k, 0, ASIDE) for k in range(40)])
    truth = record.trajectory()
    record.tracked = [
        replace(frame, result=replace(frame.result, reference=replace(
            frame.result.reference, T_keyframe_cam=frame.result.T_world_cam,
        ))) for frame in record.tracked if frame.result.reference is not None
    ]  # fmt: skip
    record.final = FinalMap(STEP[None], STEP[None], np.zeros(1, np.int32), [])
    accuracy = assess_run(record, truth)
    assert accuracy.optimized is not None and accuracy.optimized.ate is not None
    assert accuracy.optimized.ate.rmse_cm < 1e-6
    report = report_of(record, accuracy)
    assert report['optimized']['ate']['rmse_cm'] < 1e-6 and 'coverage' in report['ate']


def a_trajectory(frames: int) -> Trajectory:
    record = RunRecord('room', 'full', tracked=[tracked(k) for k in range(frames)])
    return record.trajectory()


def test_accuracy_of_a_moved_copy_is_perfect() -> None:
    truth = a_trajectory(30)
    T = se3.exp(np.array([1.0, -2.0, 3.0, 0.4, 0.5, -0.6]))
    accuracy = assess(replace(truth, T_world_cam=T @ truth.T_world_cam), truth)
    assert accuracy.ate is not None
    assert accuracy.rpe_1s is not None
    report = report_of(a_record(), accuracy)
    assert list(report['ate']) == ['rmse_cm', 'mean_cm', 'median_cm', 'max_cm', 'coverage']
    assert report['ate']['coverage'] is None  # of a trajectory alone it is not known
    assert list(report['rpe_1s']) == ['trans_rmse_cm', 'rot_rmse_deg']
    assert report['ate']['max_cm'] < ROUNDING
    assert report['rpe_1s']['trans_rmse_cm'] < ROUNDING


def test_what_is_not_computed_has_a_reason() -> None:
    assert assess(a_trajectory(5), None) == Accuracy()
    short = assess(a_trajectory(5), a_trajectory(5))
    assert short.ate is not None
    assert short.rpe_1s is None
    assert '1 s apart' in short.why_no_rpe
    truth = a_trajectory(5)
    late = replace(truth, stamps_ns=truth.stamps_ns + 10**12)
    none = assess(a_trajectory(5), late)
    assert none.ate is None
    assert none.rpe_1s is None
    assert 'found 0 of 5' in none.why_no_ate


def a_run(lost: set[int], frames: int = 40) -> RunRecord:
    """Return a run that is right, but for frames 30 and later, which are 20 cm off."""
    record = RunRecord('room', 'full')
    for k in range(frames):
        frame = tracked(k, TrackingState.LOST if k in lost else TrackingState.OK)
        T = frame.result.T_world_cam.copy()
        T[:3, 3] += 0.2 * (k >= 30)
        record.tracked.append(replace(frame, result=replace(frame.result, T_world_cam=T)))
    return record


def test_a_run_is_assessed_with_what_it_claims() -> None:
    record, truth = a_run(set()), a_trajectory(40)
    accuracy = assess_run(record, truth)
    report = report_of(record, accuracy)
    assert accuracy.nees is not None and accuracy.silent is not None
    assert report['silent_frames'] == accuracy.silent.count == 10
    assert report['nees']['motions'] == 20
    assert report['nees']['median'] == pytest.approx(np.median(accuracy.nees.values))
    assert set(report['nees']) == {
        'median', 'mean', 'mean_bounds_95', 'translation_median', 'rotation_median',
        'coverage_2sigma_translation', 'coverage_2sigma_rotation', 'motions',
        'independent_motions',
    }  # fmt: skip
    assert report['ate']['coverage'] == 1.0
    json.dumps(report, allow_nan=False)


def test_the_ate_is_over_tracked_frames_and_says_their_share() -> None:
    """Of the frames with truth: skipped ones count, those without truth do not."""
    record, truth = a_run(lost=set(range(10, 20))), a_trajectory(36)
    record.tracked = [frame for frame in record.tracked if frame.index not in (3, 4)]
    record.skipped = [
        SkippedFrame(3, 3 * FRAME_NS, 'frame 4', 'refused'),
        SkippedFrame(4, None, 'frame 5', 'cut off'),
    ]
    accuracy = assess_run(record, truth)
    assert accuracy.ate is not None
    assert (accuracy.ate.poses, accuracy.ate.matched) == (28, 24)
    assert accuracy.coverage == pytest.approx(24 / 35)
    assert report_of(record, accuracy)['ate']['coverage'] == pytest.approx(24 / 35)


def test_a_run_that_is_lost_has_no_errors_but_reasons() -> None:
    record = a_run(lost=set(range(1, 40)))
    accuracy = assess_run(record, a_trajectory(40))
    assert accuracy.ate is None and accuracy.rpe_1s is None
    assert accuracy.nees is None and '1 s apart' in accuracy.why_no_nees
    assert accuracy.silent is None
    report = report_of(record, accuracy)
    assert (report['tracked'], report['lost']) == (1, 39)
    assert report['nees'] is None and report['silent_frames'] is None
    assert assess_run(record, None) == Accuracy()
