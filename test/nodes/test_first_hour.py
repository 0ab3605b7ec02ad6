# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""What a newcomer does first: the documented replay, kernels not compiled yet; a second robot."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip('rclpy')
pytest.importorskip('rosbags')

from launching import launcher  # type: ignore[import-not-found]
from robot import SENSOR, sequence  # type: ignore[import-not-found]

from dcgs_ros.cli.main import main
from dcgs_ros.datasets.open import open_source
from dcgs_ros.nodes.harness.observer import Observer, wait_until
from dcgs_ros.nodes.harness.processes import Processes

pytestmark = pytest.mark.slow

PATIENCE_S = 900.0  # only a failure takes so long
QUICK_S = 5.0  # the rest of a compilation would take far longer
TRACKED = 0.99
SCENE = 'synthetic:room?frames=60&sensor=ideal'


@pytest.mark.parametrize('kernels', ['cold', 'warm'])
def test_the_documented_replay_loses_no_part_of_a_bag(
    kernels: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if kernels == 'cold':
        monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'empty'))
    source, bag = open_source(sequence()), tmp_path / 'bag'
    assert main(['convert', sequence(), str(bag)]) == 0
    launch = launcher(monkeypatch)
    with Processes(tmp_path) as processes:
        observer = Observer(processes.domain)
        try:
            nodes = launch('replay', bag=str(bag), params=str(SENSOR)).start(processes)
            assert nodes['replay'].wait(PATIENCE_S) == 0
            time.sleep(2.0)
            assert len(observer.poses) >= TRACKED * len(source)
        finally:
            observer.close()
        said = next(tmp_path.glob('replay-*.log')).read_text()
        assert 'waiting for dcgs_tracker to subscribe to /camera/camera/color/image_raw' in said
        assert processes.stop(nodes['tracker']) == 0
        assert 'missed' not in next(tmp_path.glob('tracker-*.log')).read_text()


def test_two_robots_on_one_host_do_not_hear_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each sees another scene."""
    scenes = {name: f'{SCENE}&seed={seed}' for seed, name in enumerate(('robot1', 'robot2'))}
    frames = len(open_source(SCENE))
    launch = launcher(monkeypatch)
    with Processes(tmp_path) as processes:
        observers = {name: Observer(processes.domain, namespace=name) for name in scenes}
        try:
            nodes = [
                launch('replay', source=scene, namespace=name).start(processes)
                for name, scene in scenes.items()
            ]
            for started in nodes:
                assert started['replay'].wait(PATIENCE_S) == 0
            time.sleep(2.0)
            for name, observer in observers.items():
                assert len(observer.poses) >= TRACKED * frames
                assert observer.came <= frames and observer.sent <= frames
                _, _, figures = observer.status[f'{name}/dcgs_tracker']
                assert int(figures['color']) == frames
                wait_until(lambda o=observer: len(o.keyframes) > 0, PATIENCE_S, name)  # type: ignore
        finally:
            for observer in observers.values():
                observer.close()


@pytest.mark.parametrize('node', ['tracker', 'mapper'])
def test_a_node_that_compiles_reports_answers_and_ends_at_once(
    node: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'empty'))
    with Processes(tmp_path) as processes:
        observer = Observer(processes.domain)
        try:
            started = processes.start(node)
            wait_until(lambda: len(observer.history) >= 3, PATIENCE_S, 'reports')
            before = len(observer.history)
            assert observer.call(f'/dcgs_{node}/reset').success
            wait_until(lambda: len(observer.history) >= before + 3, PATIENCE_S, 'more reports')
            assert all('loading' in text for *_, text in observer.history)
            start_s = time.monotonic()
            assert processes.stop(started) == 0
            assert time.monotonic() - start_s < QUICK_S
        finally:
            observer.close()
    assert 'Traceback' not in next(tmp_path.glob(f'{node}-*.log')).read_text()


@pytest.mark.parametrize('after_s', [0.3, 0.6, 1.0, 1.6, 2.4])
def test_a_signal_while_a_node_is_imported_ends_it_in_silence(
    after_s: float, ros_environment: dict[str, str]
) -> None:
    program = 'import sys; from dcgs_ros.nodes.start import tracker; sys.exit(tracker())'
    process = subprocess.Popen(
        [sys.executable, '-c', program], env=ros_environment, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    time.sleep(after_s)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0 and 'Traceback' not in out, out


def test_a_second_tracker_costs_the_mapper_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Processes(tmp_path) as processes:
        observer = Observer(processes.domain)
        reliable = {'node.reliability': 'reliable', 'node.resume': False}
        play = {'source': SCENE, 'wait_for_node': 'dcgs_tracker'}
        try:
            processes.start('mapper')
            first = processes.start('tracker', reliable)
            assert processes.start('replay', play).wait(PATIENCE_S) == 0
            wait_until(lambda: observer.value('dcgs_mapper', 'keyframes') > 0, PATIENCE_S, 'map')
            gaussians = observer.value('dcgs_mapper', 'gaussians')
            color = ('camera/camera/color/image_raw', 'second/color')
            processes.start('tracker', reliable, remappings=(('__node', 'second'), color))
            other = play | {'wait_for_node': 'second', 'source': SCENE.replace('60', '90')}
            replay = processes.start('replay', other, remappings=(color,))
            assert replay.wait(PATIENCE_S) == 0
            said = lambda: observer.status['dcgs_mapper'][1]  # noqa: E731
            wait_until(lambda: 'another tracker speaks' in said(), PATIENCE_S, 'that is said')
            assert observer.value('dcgs_mapper', 'gaussians') > 0.8 * gaussians
            assert observer.value('dcgs_mapper', 'foreign') > 0
            assert processes.stop(first) == 0
            gone = 'the tracker began a new map'
            log = next(tmp_path.glob('mapper-*.log'))
            wait_until(lambda: gone in log.read_text(), PATIENCE_S, 'the second one is heard')
        finally:
            observer.close()
