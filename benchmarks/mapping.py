# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Quality of maps: `python -m benchmarks.mapping [--data FOLDER] [--only NAME]`.

Runs `dcgs run` on the real sequences found in FOLDER and on the synthetic room, in every mode, and
compares all frames. Tables: rendering scores; time, memory and tracking; and how far the means of
the tracker's Gaussians moved from where they were measured, and how flat Sigma_r is.

With --memory instead: memory with a large map, and over a long run.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels.workers import Workers, cores
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.core.slam import Lockstep
from dcgs_ros.core.tracking.tracker import Tracker
from dcgs_ros.datasets.open import open_source
from dcgs_ros.datasets.source import Source
from dcgs_ros.evaluation.host import machine

from . import memory
from .accuracy import REAL

SYNTHETIC = 'synthetic:room'
MODES: dict[str, tuple[str, ...]] = {
    'default': (),
    'high': ('--quality', 'high'),
    'online': ('--online',),
}
TRACKED_ONLY = ('--no-mapping',)
UNBOUNDED = 1e6  # sigmas


def run(address: str, options: Sequence[str]) -> dict[str, Any]:
    """Run `dcgs run`, comparing every frame, and return its report."""
    with TemporaryDirectory() as folder:
        command = [sys.executable, '-m', 'dcgs_ros.cli', 'run', address, *options]
        command += ['--render-every', '1', '--out', f'{folder}/run']
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        if done.returncode:
            raise SystemExit(done.stdout)
        report: dict[str, Any] = json.loads(Path(folder, 'run/report.json').read_text())
        return report


def print_row(*cells: str) -> None:
    """Print a row of a Markdown table."""
    print(f'| {" | ".join(cells)} |', flush=True)


def print_head(title: str, *columns: str) -> None:
    """Print the title and the head of a Markdown table."""
    print(f'\n{title}\n')
    print_row(*columns)
    print_row(*['---'] * len(columns))


def show_images(reports: dict[tuple[str, str], dict[str, Any]]) -> None:
    """Print PSNR in dB, SSIM and LPIPS of the maps under each protocol."""
    print_head(
        'PSNR dB / SSIM / LPIPS, all frames',
        'sequence, mode', 'raw', 'interpolated', 'depth-masked', 'keyframes, raw', 'others, raw',
        'transmittance',
    )  # fmt: skip
    for (name, mode), report in reports.items():
        rendering = report['rendering']
        groups = (
            rendering[key] for key in ('interpolated', 'depth_masked', 'keyframes', 'others')
        )
        scores = [_scores(group) for group in (rendering, *groups)]
        print_row(f'{name}, {mode}', *scores, f'{rendering["mean_transmittance"]:.4f}')


def _scores(means: dict[str, Any]) -> str:
    numbers = (means['psnr_db'], means['ssim'], means['lpips'])
    formats = ('.2f', '.3f', '.3f')
    return ' / '.join(
        '-' if x is None else f'{x:{f}}' for x, f in zip(numbers, formats, strict=True)
    )


def show_costs(
    reports: dict[tuple[str, str], dict[str, Any]], tracked_only: dict[str, dict[str, Any]]
) -> None:
    """Print the cost of the maps, and tracking with and without mapping."""
    print_head(
        'What it took, and tracking with and without it',
        'sequence, mode', 'Gaussians', 'steps', 'mapping s', 'tracker p95 ms', 'dropped',
        'ATE cm', 'ATE cm without mapping', 'peak MB',
    )  # fmt: skip
    for (name, mode), report in reports.items():
        mapping = report['mapping']
        print_row(
            f'{name}, {mode}', f'{mapping["gaussians"]}', f'{mapping["iterations"]}',
            f'{mapping["iterations"] / mapping["iterations_per_s"]:.0f}',
            f'{report["tracking"]["ms_p95"]:.1f}', f'{report["dropped"]}',
            _ate_cm(report), _ate_cm(tracked_only[name]),
            f'{report["peak_rss_mb"]:.0f}',
        )  # fmt: skip


def _ate_cm(report: dict[str, Any]) -> str:
    return '-' if report['ate'] is None else f'{report["ate"]["rmse_cm"]:.2f}'


@dataclass(frozen=True)
class MeanShifts:
    """How mapping changed the tracker's Gaussians that are left at the end of a run."""

    moved: NDArray[
        np.floating
    ]  # (N,) distances from the measured means, in sigma_z of their depth
    flatness: NDArray[np.floating]  # (N,) lambda3 / lambda2 of Sigma_r


def mean_shifts(source: Source, reach_sigmas: float) -> MeanShifts:
    """Track and map in lockstep; return how far means moved relative to their host keyframes."""
    config = override(Config(sensor=source.sensor), {'mapping.reach_sigmas': reach_sigmas})
    with closing(Workers(cores())) as workers:
        tracker = Tracker(source.camera, config)
        mapper = Mapper(source.camera, config, workers=workers)
        mapping = Lockstep(tracker, mapper)
        for frame in source:
            if isinstance(frame, RgbdFrame):
                mapping.after(frame, tracker.track(frame))
                mapping.advance()
        for _ in mapping.finish():
            pass
    table = mapper.table
    columns = np.flatnonzero(table.ids >= 0)
    shifts = table.splats.means[:, columns] - table.anchors[:, columns]
    sigma_z = table.reach_m[columns] / reach_sigmas
    return MeanShifts(np.linalg.norm(shifts, axis=0) / sigma_z, table.splats.shape(columns)[1])


def show_mean_shifts(addresses: Sequence[str]) -> None:
    """Print how far means moved, and how flat Sigma_r is."""
    print_head(
        "How far the means of the tracker's Gaussians moved, in sigma_z, and Sigma_r",
        'sequence', 'reach', 'Gaussians', 'moved: median', '97.5 %', 'within 1 sigma_z',
        'lambda3 / lambda2: quartiles',
    )  # fmt: skip
    for address in addresses:
        for reach_sigmas in (Config().mapping.reach_sigmas, UNBOUNDED):
            found = mean_shifts(open_source(address), reach_sigmas)
            print_row(
                Path(address).name,
                'none' if reach_sigmas == UNBOUNDED else f'{reach_sigmas:g}',
                str(len(found.moved)),
                *(f'{x:.2f}' for x in np.percentile(found.moved, [50, 97.5])),
                f'{np.mean(found.moved < 1):.1%}',
                ' '.join(f'{x:.3f}' for x in np.percentile(found.flatness, [25, 50, 75])),
            )


def sequences(data: Path, only: str) -> Iterator[str]:
    """Yield the addresses of the available sequences whose names contain `only`."""
    for name in REAL:
        if only in name and (data / name).is_dir():
            yield str(data / name)
        elif only in name:
            print(f'{name}: not in {data}')
    if only in SYNTHETIC:
        yield SYNTHETIC


def show_quality(addresses: Sequence[str]) -> None:
    """Run all modes of all sequences and print the tables."""
    reports, tracked_only = {}, {}
    for address in addresses:
        name = Path(address).name
        tracked_only[name] = run(address, TRACKED_ONLY)
        for mode, options in MODES.items():
            reports[name, mode] = report = run(address, options)
            psnr_db = report['rendering']['psnr_db']
            print(f'{name}, {mode}: {psnr_db:.2f} dB', file=sys.stderr, flush=True)
    show_images(reports)
    show_costs(reports, tracked_only)
    show_mean_shifts(addresses)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--data', type=Path, default=os.environ.get('DCGS_TEST_DATA', '.'))
    parser.add_argument(
        '--only', default='', metavar='NAME', help='sequences whose name contains this'
    )
    parser.add_argument('--memory', action='store_true')
    parser.add_argument('--plot', type=Path, metavar='FILE.png', help='plot the memory')
    arguments = parser.parse_args()
    print(machine())
    if arguments.memory:
        memory.show(arguments.plot)
    else:
        show_quality(list(sequences(arguments.data, arguments.only)))


if __name__ == '__main__':
    main()
