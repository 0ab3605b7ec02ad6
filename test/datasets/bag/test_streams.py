# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""The topics of each camera driver are told apart by their names."""

from __future__ import annotations

import itertools

import pytest

from dcgs_ros.datasets.bag.streams import Stream, best_pairs, stream_of

ZED4 = [
    f'/zed/zed_node/{name}'
    for name in (
        'rgb/image_rect_color', 'rgb/image_rect_gray', 'rgb_raw/image_raw_color',
        'left/image_rect_color', 'left_raw/image_raw_color', 'right/image_rect_color',
        'right_raw/image_raw_color', 'stereo/image_rect_color', 'stereo_raw/image_raw_color',
        'depth/depth_registered', 'confidence/confidence_map',
    )
]  # fmt: skip
ZED5 = [
    f'/zed/zed_node/{name}'
    for name in (
        'rgb/color/rect/image', 'rgb/color/raw/image', 'rgb/gray/rect/image',
        'left/color/rect/image', 'right/color/rect/image', 'left/gray/rect/image',
        'stereo/color/rect/image', 'depth/depth_registered', 'confidence/confidence_map',
    )
]  # fmt: skip
KINECT2 = [
    f'/kinect2/{size}/image_{name}'
    for size in ('hd', 'qhd', 'sd')
    for name in ('color', 'color_rect', 'depth_rect', 'mono', 'mono_rect')
] + ['/kinect2/sd/image_depth', '/kinect2/sd/image_ir', '/kinect2/sd/image_ir_rect']
AZURE = [
    f'/k4a/{name}/image_raw' for name in ('rgb', 'depth', 'depth_to_rgb', 'rgb_to_depth', 'ir')
]
ORBBEC = [f'/camera/{name}/image_raw' for name in ('color', 'depth', 'ir', 'left_ir', 'right_ir')]
REALSENSE = [
    f'/camera/camera/{name}'
    for name in (
        'color/image_raw', 'aligned_depth_to_color/image_raw', 'depth/image_rect_raw',
        'infra1/image_rect_raw', 'infra2/image_rect_raw', 'aligned_depth_to_infra1/image_raw',
    )
]  # fmt: skip
OPENNI = [
    f'/camera/{name}'
    for name in (
        'rgb/image_raw', 'rgb/image_rect_color', 'rgb/image_mono', 'ir/image', 'depth/image_raw',
        'depth/image_rect', 'depth_registered/image_raw', 'depth_registered/image',
        'depth_registered/hw_registered/image_rect_raw',
    )
]  # fmt: skip
VIEWER = [
    f'/device_0/{name}/image/data'
    for name in ('sensor_0/Infrared_1', 'sensor_0/Depth_0', 'sensor_1/Color_0')
]
SPOT = [
    f'/{kind}/{side}/image'
    for kind in ('camera', 'depth_registered')
    for side in ('back', 'frontleft', 'hand')
]


def without(names: list[str], *words: str) -> list[str]:
    return [name for name in names if not any(word in name for word in words)]


def pairs_of(names: list[str], color: str = '', depth: str = '') -> list[tuple[str, str]]:
    streams = [Stream(name, name) for name in names]
    colors = [s for s in streams if (s.name == color if color else s.kind != 'depth')]
    depths = [s for s in streams if (s.name == depth if depth else s.kind == 'depth')]
    return [(one.name, other.name) for one, other in best_pairs(colors, depths)]


@pytest.mark.parametrize(
    ('names', 'color', 'depth'),
    [
        (ZED4, '/zed/zed_node/rgb/image_rect_color', '/zed/zed_node/depth/depth_registered'),
        (
            without(ZED4, '/rgb'),
            '/zed/zed_node/left/image_rect_color',
            '/zed/zed_node/depth/depth_registered',
        ),
        (ZED5, '/zed/zed_node/rgb/color/rect/image', '/zed/zed_node/depth/depth_registered'),
        (KINECT2, '/kinect2/qhd/image_color_rect', '/kinect2/qhd/image_depth_rect'),
        (
            without(KINECT2, 'qhd'),
            '/kinect2/hd/image_color_rect',
            '/kinect2/hd/image_depth_rect',
        ),
        (
            without(KINECT2, 'hd'),
            '/kinect2/sd/image_color_rect',
            '/kinect2/sd/image_depth_rect',
        ),
        (AZURE, '/k4a/rgb/image_raw', '/k4a/depth_to_rgb/image_raw'),
        (without(AZURE, '_to_rgb'), '/k4a/rgb_to_depth/image_raw', '/k4a/depth/image_raw'),
        (without(AZURE, '_to_'), '/k4a/rgb/image_raw', '/k4a/depth/image_raw'),
        (ORBBEC, '/camera/color/image_raw', '/camera/depth/image_raw'),
        (
            REALSENSE,
            '/camera/camera/color/image_raw',
            '/camera/camera/aligned_depth_to_color/image_raw',
        ),
        (
            without(REALSENSE, '_to_color'),
            '/camera/camera/color/image_raw',
            '/camera/camera/depth/image_rect_raw',
        ),
        (
            without(REALSENSE, 'color', '_to_'),
            '/camera/camera/infra1/image_rect_raw',
            '/camera/camera/depth/image_rect_raw',
        ),
        (
            without(REALSENSE, 'color', 'infra2'),
            '/camera/camera/infra1/image_rect_raw',
            '/camera/camera/aligned_depth_to_infra1/image_raw',
        ),
        (OPENNI, '/camera/rgb/image_raw', '/camera/depth_registered/image_raw'),
        (
            without(OPENNI, 'depth_registered/image', '/image_raw'),
            '/camera/rgb/image_rect_color',
            '/camera/depth_registered/hw_registered/image_rect_raw',
        ),
        (VIEWER, '/device_0/sensor_1/Color_0/image/data', '/device_0/sensor_0/Depth_0/image/data'),
        (
            ['/front_stereo_camera/left/image_rect_color', '/front_stereo_camera/depth',
             '/front_stereo_camera/right/image_rect_color'],
            '/front_stereo_camera/left/image_rect_color',
            '/front_stereo_camera/depth',
        ),
        (
            ['/d/sensor_0/ir/image', '/d/sensor_0/depth/image', '/d/sensor_1/color/image'],
            '/d/sensor_1/color/image',
            '/d/sensor_0/depth/image',
        ),
        (['/a/image', '/a/rgb/image', '/a/depth/image'], '/a/rgb/image', '/a/depth/image'),
        (['/rgb', '/depth', '/semantic_segmentation'], '/rgb', '/depth'),
        (
            ['/rgbd_camera/image', '/rgbd_camera/depth_image'],
            '/rgbd_camera/image',
            '/rgbd_camera/depth_image',
        ),
        (['/rgbImage', '/depthImage'], '/rgbImage', '/depthImage'),
        (['/frontColor', '/rearColor', '/frontDepth'], '/frontColor', '/frontDepth'),
        (
            ['/a/color/image', '/a/depth/image', '/keyframe/color', '/keyframe/depth',
             '/render/color', '/render/depth'],
            '/a/color/image',
            '/a/depth/image',
        ),
        (['/a/rgb', '/a/depth', '/b/rgb', '/b/left', '/c/ir'], '/a/rgb', '/a/depth'),
    ],
)  # fmt: skip
def test_all_that_a_driver_sends_gives_one_pair(names: list[str], color: str, depth: str) -> None:
    for order in (names, names[::-1], sorted(names)):
        assert pairs_of(order) == [(color, depth)]


CAMERAS = {
    'namespaces': ['/cam{}/color/image_raw', '/cam{}/depth/image_raw'],
    'nested': ['/robot/cam_{}/rgb/image', '/robot/cam_{}/depth_registered/image'],
    'suffixes': ['/color_{}/image', '/depth_{}/image'],
    'digits': ['/rgb{}', '/depth{}'],
    'prefixes': ['/{}_color/image_raw', '/{}_aligned_depth_to_color/image_raw'],
    'RealSenses': ['/camera{}/color/image_raw', '/camera{}/depth/image_rect_raw'],
    'Oak': ['/oak{}/rgb/image_raw', '/oak{}/stereo/depth'],
}


@pytest.mark.parametrize('kind', CAMERAS)
def test_of_several_cameras_none_is_chosen_until_one_is_named(kind: str) -> None:
    color, depth = CAMERAS[kind]
    cameras = [(color.format(k), depth.format(k)) for k in (1, 2, 3)]
    names = list(itertools.chain.from_iterable(cameras))
    assert pairs_of(names) == cameras
    for one, other in cameras:
        assert pairs_of(names, color=one) == pairs_of(names, depth=other) == [(one, other)]


def test_each_kinect2_resolution_keeps_its_own_depth() -> None:
    for size in ('hd', 'qhd', 'sd'):
        color, depth = f'/kinect2/{size}/image_color_rect', f'/kinect2/{size}/image_depth_rect'
        assert pairs_of(KINECT2, color=color) == pairs_of(KINECT2, depth=depth) == [(color, depth)]


def test_named_among_the_cameras_of_a_robot_the_depth_follows() -> None:
    for side in ('back', 'frontleft', 'hand'):
        color, depth = f'/camera/{side}/image', f'/depth_registered/{side}/image'
        assert pairs_of(SPOT, color=color) == [(color, depth)]
    assert len(pairs_of(SPOT)) == 3


@pytest.mark.parametrize('transport', ['compressed', 'compressedDepth', 'zstd'])
def test_a_transport_is_a_suffix_of_the_stream(transport: str) -> None:
    for stream in ('/camera/color/image_raw', '/rgb', '/robot/front/depth'):
        assert stream_of(f'{stream}/{transport}') == stream_of(stream) == stream
