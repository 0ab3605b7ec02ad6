# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Images get through, and the profile that lets them is found."""

from __future__ import annotations

import os
import queue
import shutil
import subprocess
import sys
import threading
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

pytest.importorskip('rclpy')

from rclpy.qos import DurabilityPolicy, QoSCompatibility, ReliabilityPolicy, qos_check_compatible

from dcgs_ros.nodes import transport
from dcgs_ros.nodes.transport import RELIABLE, latched, prepare, profiles_file, sensor_qos

ROOT = Path(__file__).resolve().parents[2]
VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
NAMESPACE = '{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}'
CONTAINER_SHM_BYTES = 64 << 20  # /dev/shm of a Docker container
FRAMES = 45  # one after the other; without the profile half are lost
PATIENCE_S, AGAIN_S = 60.0, 0.5  # only a failure takes so long; until both know each other

WRITER = """
import array, sys, time
from dcgs_ros.nodes.transport import prepare, sensor_qos
prepare()
import rclpy
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node('writer')
qos = sensor_qos('best_effort')
images = []
for name, channels in (('color', 3), ('depth', 2)):
    image = Image(width=640, height=480, step=640 * channels)
    image.data = array.array('B', bytes(480 * image.step))
    images.append((image, node.create_publisher(Image, name, qos)))
while not all(publisher.get_subscription_count() for _, publisher in images):
    time.sleep(0.01)
for line in sys.stdin:
    for image, publisher in images:
        image.header.stamp.sec = int(line)
        publisher.publish(image)
"""
READER = """
from dcgs_ros.nodes.transport import prepare, sensor_qos
prepare()
import rclpy
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node('reader')
came = dict(color=[], depth=[])
for name, stamps in came.items():
    node.create_subscription(
        Image, name, lambda image, to=stamps: to.append(image.header.stamp.sec),
        sensor_qos('best_effort'))
while True:
    rclpy.spin_once(node)
    print(*(stamps[-1] if stamps else -1 for stamps in came.values()), flush=True)
"""


@pytest.mark.slow
def test_images_of_a_camera_arrive_best_effort(ros_environment: dict[str, str]) -> None:
    """Colour and depth, 640x480, each when the one before has come."""
    del ros_environment[VARIABLE]  # `prepare` is to find it
    reader, writer = (
        subprocess.Popen(
            [sys.executable, '-c', program],
            env=ros_environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for program in (READER, WRITER)
    )
    came: queue.Queue[str] = queue.Queue()

    def listen() -> None:
        for line in reader.stdout or ():
            came.put(line)

    listening = threading.Thread(target=listen)
    listening.start()

    def arrives(number: int, within_s: float) -> bool:
        assert writer.stdin is not None
        print(number, file=writer.stdin, flush=True)
        end = time.monotonic() + within_s
        try:
            while came.get(timeout=max(0.0, end - time.monotonic())) != f'{number} {number}\n':
                pass
        except queue.Empty:
            return False
        return True

    try:
        tries = round(PATIENCE_S / AGAIN_S)
        assert any(arrives(0, AGAIN_S) for _ in range(tries)), 'they have not found each other'
        for number in range(1, FRAMES + 1):
            assert arrives(number, PATIENCE_S), f'{number} is lost'
    finally:
        for process in (reader, writer):
            process.kill()
            process.wait()
        listening.join()


def test_the_profile_holds_an_image_and_fits_into_a_container() -> None:
    tree = ElementTree.parse(ROOT / 'config' / 'fastdds.xml')
    segment = tree.find(f'.//{NAMESPACE}segment_size')
    assert segment is not None and segment.text is not None
    assert 1920 * 1080 * 3 < int(segment.text) <= CONTAINER_SHM_BYTES // 4  # four processes
    ids = [element.text or '' for element in tree.iter(f'{NAMESPACE}transport_id')]
    assert sorted(ids) == sorted(['shared_memory', 'network'] * 2)  # defined, and used
    default = tree.find(f'.//{NAMESPACE}participant')
    assert default is not None and default.get('is_default_profile') == 'true'


def test_prepare_names_the_profile_unless_the_environment_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(VARIABLE, '')
    monkeypatch.delenv(VARIABLE)
    prepare()
    assert os.environ[VARIABLE] == str(ROOT / 'config' / 'fastdds.xml')
    monkeypatch.setenv(VARIABLE, 'mine.xml')
    prepare()
    assert os.environ[VARIABLE] == 'mine.xml'


@pytest.mark.parametrize('prefix', ['colcon', 'venv'])
def test_the_profile_is_found_where_it_was_installed(
    prefix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / prefix / 'share' / 'dcgs_ros' / 'config'
    folder.mkdir(parents=True)
    shutil.copy(ROOT / 'config' / 'fastdds.xml', folder)
    module = tmp_path / 'lib' / 'dcgs_ros' / 'nodes' / 'transport.py'  # without sources around
    monkeypatch.setattr(transport, '__file__', str(module))
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/nowhere{os.pathsep}{tmp_path / "colcon"}')
    monkeypatch.setattr(sys, 'prefix', str(tmp_path / 'venv'))
    assert profiles_file() == folder / 'fastdds.xml'


def test_without_a_profile_the_environment_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transport, '__file__', str(tmp_path / 'a' / 'b' / 'c.py'))
    monkeypatch.setattr(sys, 'prefix', str(tmp_path))
    monkeypatch.delenv('AMENT_PREFIX_PATH', raising=False)
    monkeypatch.delenv(VARIABLE, raising=False)
    prepare()
    assert VARIABLE not in os.environ


def test_publishers_and_subscribers_of_ours_fit_together() -> None:
    live, sure = sensor_qos('best_effort'), sensor_qos('reliable')
    assert live.reliability == ReliabilityPolicy.BEST_EFFORT
    for publisher, subscriber in (
        (sure, sure),
        (sure, live),
        (live, live),
        (latched(3), RELIABLE),
    ):
        assert qos_check_compatible(publisher, subscriber)[0] != QoSCompatibility.ERROR
    assert qos_check_compatible(live, sure)[0] == QoSCompatibility.ERROR
    assert latched(3).durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert (latched(3).depth, live.depth, RELIABLE.depth) == (3, 5, 32)
