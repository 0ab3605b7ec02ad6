# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Speed of renderer and mapper: `python -m benchmarks.rendering [--repeats 15] [--plot FILE]`.

A mapper with one view of a synthetic surface, all of whose Gaussians are in the image. Tables: the
parts of an optimisation step with one and two threads; their cost by Gaussians and by pixels; the
renderer against the tests' reference in torch; and the time to compile the kernels. The rows of a
table are measured in turns, so that changes of the machine's speed affect all of them; times are
medians over the turns.
"""

from __future__ import annotations

import argparse
import importlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.frame import RgbdFrame
from dcgs_ros.core.kernels.workers import Workers
from dcgs_ros.core.mapping.losses import ImageLoss
from dcgs_ros.core.mapping.mapper import Mapper
from dcgs_ros.core.mapping.rectification import Rectifier
from dcgs_ros.core.mapping.splats import PLANES
from dcgs_ros.core.mapping.views import KeyframeView
from dcgs_ros.core.render.cpu import CpuRenderer
from dcgs_ros.core.render.renderer import View
from dcgs_ros.evaluation.host import machine

from .gaussian_surface import wavy_surface

PHASES = ('target', 'render', 'loss', 'backward', 'Adam')
RENDER = PHASES.index('render')
THREADS = (1, 2)
COUNTS = (20_000, 50_000, 100_000, 200_000, 400_000)
SIZES = ((160, 120), (320, 240), (640, 480), (1280, 960))
COUNT, SIZE = 100_000, (640, 480)  # held fixed while the other varies
STEPS = 4  # in a turn; one of them fits the exposure
REFERENCE_REPEATS = 2
ROOT = Path(__file__).parents[1]


class Case(NamedTuple):
    """A row of a table: what is rendered, and with how many threads."""

    gaussians: int
    size: tuple[int, int]  # width, height
    threads: int = 2
    shuffled: bool = False  # else in the order of the image, as when a keyframe spawns them

    def __str__(self) -> str:
        """Name the row."""
        width, height = self.size
        order = ', shuffled' if self.shuffled else ''
        threads = '1 thread' if self.threads == 1 else f'{self.threads} threads'
        return f'{width}x{height} {self.gaussians // 1000}k{order}, {threads}'


class Requirement(NamedTuple):
    """Required and desired speed of a case; None: no requirement."""

    case: Case
    steps_per_s: tuple[float, float]
    render_ms: tuple[float, float] | None


REQUIREMENTS = (
    Requirement(Case(100_000, (640, 480)), (20, 30), (15, 9)),
    Requirement(Case(50_000, (320, 240)), (55, 80), None),
)
MIN_RATIO = 50.0  # of the reference's time to ours
MAX_COMPILE_S = {'cold': 15.0, 'cached': 2.0}


class Bench:
    """A mapper that optimises one view repeatedly, with learning rates of zero."""

    def __init__(self, case: Case) -> None:
        """Create the scene, and a keyframe from its rendering with noise."""
        splats, camera = wavy_surface(case.gaussians, *case.size, case.shuffled)
        config = override(Config(), {'mapping.trial_visits': 100_000})  # keep hidden Gaussians
        workers = Workers(case.threads)
        self.workers, self.renderer = workers, CpuRenderer(workers)
        self.mapper = Mapper(camera, config, self.renderer, workers)
        anywhere = np.full(len(splats), np.inf, np.float32)
        self.mapper.table.append(splats, np.arange(len(splats)), 0, splats.means, anywhere)
        self.valid = np.ones((camera.height, camera.width), np.bool_)
        self.loss = ImageLoss(
            camera.width, camera.height, config.mapping.ssim_weight, config.mapping.depth_weight,
            workers,
        )  # fmt: skip
        self.view = View.of(camera, np.eye(4))
        images = Rectifier(camera)(self._frame())
        self.keyframe = KeyframeView.of(0, 0, np.eye(4), images, None)
        self.mapper.views.append(self.keyframe)

    def _frame(self) -> RgbdFrame:
        rendering = self.renderer.render(self.mapper.table.planes, self.view)
        noise = np.random.default_rng(1).normal(0, 0.03, rendering.color.shape)
        color = (255 * (rendering.color + noise)).clip(0, 255).astype(np.uint8)
        depth_m = rendering.depth / np.maximum(1 - rendering.transmittance, 1e-3)
        color = np.ascontiguousarray(np.moveaxis(color, 0, -1))
        return RgbdFrame(0, 0, color, depth_m.astype(np.float32))

    def step(self) -> None:
        """Take one of the mapper's steps, at full resolution."""
        self.mapper.step(rate=0.0, replay=True)

    def parts(self) -> NDArray[np.float64]:
        """Return milliseconds (5,) of the parts of a step, as in `PHASES`."""
        times = [time.perf_counter()]
        target = self.keyframe.target(self.valid, 1, self.workers)
        times.append(time.perf_counter())
        rendering = self.renderer.render(self.mapper.table.planes, self.view)
        times.append(time.perf_counter())
        behind = np.zeros(3, np.float32)
        exposure = self.keyframe.exposure
        by_image = self.loss.gradient(rendering.planes, target, exposure, behind)
        times.append(time.perf_counter())
        gradients = self.renderer.backward(by_image)
        times.append(time.perf_counter())
        self.mapper.table.step(gradients, np.zeros(len(PLANES), np.float32), self.workers)
        times.append(time.perf_counter())
        return 1e3 * np.diff(times)

    def turn(self) -> NDArray[np.float64]:
        """Return milliseconds (6,) of the parts and of a whole step."""
        self.step()  # the caches hold another row's data
        start = time.perf_counter()
        for _ in range(STEPS):
            self.step()
        whole_ms = 1e3 * (time.perf_counter() - start) / STEPS
        parts_ms = np.median([self.parts() for _ in range(STEPS)], axis=0)
        return np.append(parts_ms, whole_ms)


def seconds(work: Callable[[], Any]) -> float:
    """Return how long a call takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def measured(cases: Sequence[Case], repeats: int) -> NDArray[np.float64]:
    """Return milliseconds (cases, 6), medians over `repeats` turns."""
    benches = [Bench(case) for case in cases]
    turns = np.array([[bench.turn() for bench in benches] for _ in range(repeats)])
    for bench in benches:
        bench.workers.close()
    return np.asarray(np.median(turns, axis=0))


def table(title: str, cases: Sequence[Case], repeats: int) -> NDArray[np.float64]:
    """Measure and print milliseconds (cases, 6), and return them."""
    times = measured(cases, repeats)
    print(f'\n{title}: ms, medians of {repeats} turns')
    print(f'{"":34s}' + ''.join(f'{phase:>9s}' for phase in (*PHASES, 'step', 'steps/s')))
    for case, row in zip(cases, times, strict=True):
        numbers = ''.join(f'{ms:9.2f}' for ms in row)
        print(f'{case!s:34s}{numbers}{1e3 / row[-1]:9.1f}', flush=True)
    return times


def show_requirements(repeats: int) -> None:
    """Measure the required cases and print their speeds beside the requirements."""
    cases = [
        requirement.case._replace(threads=threads, shuffled=shuffled)
        for requirement in REQUIREMENTS
        for shuffled in (False, True)
        for threads in THREADS
    ]
    times = dict(zip(cases, table('One step', cases, repeats), strict=True))
    for case, steps_per_s, render_ms in REQUIREMENTS:
        row, (least, aim) = times[case], steps_per_s
        text = f'{case}: {1e3 / row[-1]:.1f} steps/s (at least {least:g}, aim {aim:g})'
        if render_ms is not None:
            most, aim = render_ms
            text += f'; render {row[RENDER]:.1f} ms (at most {most:g}, aim {aim:g})'
        print(text)


def compare_with_reference() -> None:
    """Print the time of forward and backward pass, of the tests' reference and of the renderer."""
    import torch  # seconds to load

    sys.path.insert(0, str(ROOT / 'test/core/render'))  # `test` itself is no package
    render_tiled = importlib.import_module('reference').render_tiled
    case = REQUIREMENTS[0].case
    torch.set_num_threads(case.threads)
    bench = Bench(case)
    planes = bench.mapper.table.splats.planes
    upstream = np.ones((5, bench.view.height, bench.view.width), np.float32)

    def ours() -> None:
        bench.renderer.render(planes, bench.view)
        bench.renderer.backward(upstream)

    ours()
    ours_s: list[float] = []
    both: list[tuple[float, float]] = []
    for _ in range(REFERENCE_REPEATS):
        leaf, xi = torch.tensor(planes, requires_grad=True), torch.zeros(6, requires_grad=True)
        start = time.perf_counter()
        image = render_tiled(leaf, bench.view, xi)
        middle = time.perf_counter()
        image.backward(torch.from_numpy(upstream))
        both.append((middle - start, time.perf_counter() - middle))
        ours_s += [seconds(ours) for _ in range(STEPS)]
    forward_s, backward_s = np.median(both, axis=0)
    shown = bench.renderer.render(planes, bench.view).planes
    difference = float(np.abs(image.detach().numpy() - shown).max())
    ratio = (forward_s + backward_s) / np.median(ours_s)
    print(
        f'\n{case}, forward and backward: torch, tiles of 16 pixels, {forward_s:.1f} + '
        f'{backward_s:.1f} s; ours {1e3 * np.median(ours_s):.1f} ms: {ratio:.0f} times as fast '
        f'(at least {MIN_RATIO:g}); images differ by {difference:.1g} at most',
        flush=True,
    )
    bench.workers.close()


def first_step(import_s: float) -> None:
    """Print the seconds that the imports take, and the first steps more than later ones."""
    small = Case(2000, (160, 120))

    def start() -> None:
        bench = Bench(small)
        for _ in range(STEPS):
            bench.step()
        bench.workers.close()

    print(import_s, seconds(start) - seconds(start))


_IN_FRESH_PROCESS = """
import time
start = time.perf_counter()
from benchmarks.rendering import first_step
first_step(time.perf_counter() - start)
"""


def compilation() -> None:
    """Print how long the kernels take to compile, and to load from the cache."""
    print('\nKernels of renderer, loss and Adam, in a fresh process')
    with TemporaryDirectory() as cache:
        for name, limit_s in MAX_COMPILE_S.items():
            done = subprocess.run(
                [sys.executable, '-c', _IN_FRESH_PROCESS], cwd=ROOT, check=True, text=True,
                env=os.environ | {'NUMBA_CACHE_DIR': cache}, stdout=subprocess.PIPE,
            )  # fmt: skip
            import_s, compile_s = map(float, done.stdout.split())
            print(
                f'{name:7s} {compile_s:5.1f} s (at most {limit_s:g}); imports {import_s:.1f} s',
                flush=True,
            )


def plot(path: Path, by_count: NDArray[np.float64], by_size: NDArray[np.float64]) -> None:
    """Plot milliseconds (cases, 6) by COUNTS, and others by SIZES."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    figure = Figure(figsize=(10.0, 4.6), dpi=120, layout='constrained')
    FigureCanvasAgg(figure)
    pixels = [width * height for width, height in SIZES]
    plots = (
        (COUNTS, by_count, f'Gaussians, all in an image of {SIZE[0]}x{SIZE[1]}'),
        (pixels, by_size, f'pixels, {COUNT // 1000}k Gaussians'),
    )
    for ax, (x, times, label) in zip(figure.subplots(1, 2, sharey=True), plots, strict=True):
        for phase, ms in zip((*PHASES, 'whole step'), times.T, strict=True):
            ax.loglog(x, ms, 'o-', linewidth=2.4 if phase == 'whole step' else 1.3, label=phase)
        ax.set(xlabel=label, ylabel='ms')
        ax.set_xticks(x, [f'{value / 1000:g}k' for value in x])
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter('{x:g}')
        ax.minorticks_off()
        ax.grid(alpha=0.25)
    ax.legend(fontsize=8, loc='upper left', bbox_to_anchor=(1.0, 1.0))
    figure.suptitle(f'One step, {THREADS[-1]} threads')
    figure.savefig(path)


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--repeats', type=int, default=15)
    parser.add_argument('--plot', type=Path, metavar='FILE.png')
    arguments = parser.parse_args()
    print(machine())
    measured([Case(2000, (160, 120))], 1)  # compile
    show_requirements(arguments.repeats)
    by_count = [Case(count, SIZE, threads) for threads in THREADS for count in COUNTS]
    by_size = [Case(COUNT, size, threads) for threads in THREADS for size in SIZES]
    count_ms = table('Against Gaussians', by_count, arguments.repeats)
    size_ms = table('Against pixels', by_size, arguments.repeats)
    if arguments.plot:
        plot(arguments.plot, count_ms[-len(COUNTS) :], size_ms[-len(SIZES) :])
    compare_with_reference()
    compilation()


if __name__ == '__main__':
    main()
