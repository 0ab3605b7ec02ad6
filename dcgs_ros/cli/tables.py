# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Two-column text tables that the verbs print."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..evaluation.consistency import MotionNees, SilentFrames, coverage_2sigma
from ..evaluation.report import Accuracy

Row = tuple[str, str]

_FILES = (
    ('trajectory', 'trajectory.tum'), ('plot', 'trajectory.png'), ('map', 'map.dcgs'),
    ('views', 'views.png'),
)  # fmt: skip


def table(title: str, rows: Sequence[Row]) -> str:
    """Return the title and an indented line per row, with the second column aligned."""
    width = max(len(label) for label, _ in rows)
    return '\n'.join([title, *(f'  {label:<{width}}  {text}' for label, text in rows)])


def run_summary(report: dict[str, Any], accuracy: Accuracy, folder: Path) -> str:
    """Return the summary of a run: its report, and the paths of its files."""
    speed = report['tracking']
    title = f'{report["source"]} ({report["ablation"]})'
    if report['interrupted']:
        title += ', interrupted'
    offset_ms = report['timing']['colour_depth_offset_ms']
    rows = [
        ('frames', _counts(report)),
        ('states', _states(report['states'])),
        *[('warning', text) for text in report['warnings']],
        *accuracy_rows(accuracy),
        *_loop_rows(report),
        (
            'tracking',
            f'{speed["fps_mean"]:.0f} fps mean; {speed["ms_median"]:.1f} ms median, '
            f'{speed["ms_p95"]:.1f} p95, {speed["ms_p99"]:.1f} p99 (decoding excluded)',
        ),
        (
            'wall time',
            f'{report["wall_s"]:.1f} s in all; frames in {report["frames_s"]:.1f} s, decoding and '
            f'mapping included: {report["realtime_factor"]:.2f} x real time',
        ),
        ('depth offset', f'{offset_ms:+.1f} ms, of depth against its stamp'),
        ('Gaussians', f'{report["mapping"]["gaussians"]}'),
        ('mapping', _mapping(report['mapping'])),
        *rendering_rows(report['rendering']),
        ('kappa', _kappas(report['observability'])),
        ('memory', f'{_number(report["peak_rss_mb"])} MB at most'),
        *[(label, str(folder / name)) for label, name in _FILES if (folder / name).exists()],
        ('run folder', str(folder)),
    ]
    return table(title, rows)


def accuracy_rows(accuracy: Accuracy) -> list[Row]:
    """Return the rows of ATE, RPE, NEES and silent frames, or why they were not computed."""
    ate, rpe = accuracy.ate, accuracy.rpe_1s
    rows = [
        (
            'ATE',
            f'not computed: {accuracy.why_no_ate}'
            if ate is None
            else f'{ate.rmse_cm:.2f} cm RMSE; {ate.mean_cm:.2f} mean, {ate.median_cm:.2f} median, '
            f'{ate.max_cm:.2f} max ({ate.matched} of {ate.poses} poses{_covered(accuracy)})',
        ),
        (
            'RPE over 1 s',
            f'not computed: {accuracy.why_no_rpe}'
            if rpe is None
            else f'{rpe.trans_rmse_cm:.2f} cm, {rpe.rot_rmse_deg:.2f} deg RMSE '
            f'({rpe.pairs} pairs)',
        ),
    ]
    if accuracy.nees is not None:
        rows += _nees_rows(accuracy.nees)
    if accuracy.silent is not None:
        rows.append(('silent frames', _silent(accuracy.silent)))
    return rows


def _loop_rows(report: dict[str, Any]) -> list[Row]:
    """Return what the back end did, and the errors of what was known at the end."""
    loops, optimized = report['loops'], report['optimized']
    if loops is None:
        return []
    text = f'{loops["closed"]} closed, {loops["corrections"]} corrections of the map'
    if loops['submaps'] > 1:
        text += f'; {loops["submaps"]} sub-maps that are not joined'
    rows = [('loops', text)]
    if optimized is not None and optimized['ate'] is not None:
        ate = optimized['ate']
        rows.append(('final ATE', f'{ate["rmse_cm"]:.2f} cm RMSE; {ate["max_cm"]:.2f} max'))
    return rows


def _covered(accuracy: Accuracy) -> str:
    share = accuracy.coverage
    return '' if share is None else f'; {share:.1%} of the frames with truth'


def _nees_rows(nees: MotionNees) -> list[Row]:
    """Return the rows of NEES, each with what it is for a consistent tracker."""
    low, high = nees.mean_bounds()
    translation, rotation = (coverage_2sigma(v) for v in (nees.translation, nees.rotation))
    return [
        (
            'NEES over 1 s',
            f'{np.median(nees.values):.1f} median (ideal 5.3), {np.mean(nees.values):.1f} mean '
            f'({low:.1f} to {high:.1f})',
        ),
        (
            '  2 sigma',
            f'{translation:.0%} of translations, {rotation:.0%} of rotations within (ideal 95%)',
        ),
    ]


def _silent(silent: SilentFrames) -> str:
    reasons = ''
    if silent.count:
        reasons = (
            f' ({silent.off.sum()} more than 10 cm off in a second, '
            f'{silent.overconfident.sum()} more than 15 claimed sigma)'
        )
    return f'{silent.count} of {silent.judged.sum()}{reasons}'


def rendering_rows(rendering: dict[str, Any] | None) -> list[Row]:
    """Return the rows of the rendering scores, one per protocol and group of frames."""
    if rendering is None:
        return [('rendering', 'not evaluated')]
    rows = [('rendering', f'{_scores(rendering)} (raw; views: {rendering["views"]})')]
    rows += [
        (f'  {name.replace("_", " ")}', _scores(rendering[name]))
        for name in ('interpolated', 'depth_masked')
        if rendering[name] is not None
    ]
    rows += [
        (f'  {name}', f'{_scores(rendering[name])} (views: {rendering[name]["views"]})')
        for name in ('keyframes', 'others')
        if rendering[name]['views']
    ]
    return [*rows, ('  transmittance', f'{rendering["mean_transmittance"]:.4f} mean')]


def _scores(means: dict[str, Any]) -> str:
    lpips = 'no LPIPS' if means['lpips'] is None else f'LPIPS {means["lpips"]:.3f}'
    return f'PSNR {means["psnr_db"]:.2f} dB, SSIM {means["ssim"]:.3f}, {lpips}'


def _mapping(mapping: dict[str, Any]) -> str:
    if not mapping['iterations']:
        return 'none'
    return f'{mapping["iterations"]} steps, {mapping["iterations_per_s"]:.1f} a second'


def _counts(report: dict[str, Any]) -> str:
    dropped = f' ({report["dropped"]} dropped)' if report['dropped'] else ''
    return (
        f'{report["frames"]}: {report["tracked"]} tracked, {report["lost"]} lost, '
        f'{report["skipped"]} skipped{dropped}; {report["keyframes"]} keyframes'
    )


def _states(states: dict[str, Any]) -> str:
    """Return the number of frames in each state that occurred, and the longest stretch of it."""
    return ', '.join(
        f'{name} {state["frames"]} (longest {state["longest_s"]:.2f} s)'
        for name, state in states.items()
        if state['frames']
    )


def _kappas(medians: dict[str, float | None]) -> str:
    return (
        f'{_number(medians["kappa_median"])} median; '
        f'without radius {_number(medians["kappa_without_radius_median"])}, '
        f'rotation {_number(medians["kappa_rotation_median"])}, '
        f'translation {_number(medians["kappa_translation_median"])}'
    )


def _number(value: float | None) -> str:
    return 'none' if value is None else f'{value:.0f}'
