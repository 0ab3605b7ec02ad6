# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Metadata for colcon and pip alike: colcon reads entry points from here, not from pyproject."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'dcgs_ros'

setup(
    name=NAME,
    version='0.1.0',
    description='Dual Covariance Gaussian Splatting SLAM for ROS 2',
    author='The dcgs_ros authors',
    author_email='maintainers@dcgs-ros.org',
    maintainer='The dcgs_ros authors',
    maintainer_email='maintainers@dcgs-ros.org',
    license='BSD-3-Clause',
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*.*'))),
        (f'share/{NAME}/config/robot', sorted(glob('config/robot/*'))),
        (f'share/{NAME}/launch', sorted(glob('launch/*.launch.py'))),
    ],
    zip_safe=False,
    # colcon installs none of these: there they come from rosdep (package.xml), OpenCV as apt's
    # python3-opencv. pip does not know apt's OpenCV by this name and puts its own wheel in front
    # of it, which is harmless as long as numpy stays the system's: see the Makefile.
    install_requires=[
        'PyYAML>=6.0',
        'matplotlib>=3.6',
        'numba>=0.60',
        'numpy>=1.26',
        'opencv-python-headless>=4.8',
        'scipy>=1.11',
        'tqdm>=4.64',
        'tyro>=0.9.1',
    ],
    extras_require={
        # ROS 2 without ROS 2. Never on a sourced Jazzy, whose own rclpy must be the one used.
        'ros-wheels': [
            'ros-jazzy-rclpy[fastrtps]==7.1.6',
            'ros-jazzy-common-interfaces==5.3.6',
        ],
        'cuda': ['gsplat>=1.4', 'torch>=2.2'],
        'view': ['viser>=0.2'],
        'bags': ['lz4>=4.0', 'rosbags>=0.11', 'zstandard>=0.20'],
        'dev': [
            'evo>=1.26',  # GPL: the reference in tests, never imported by the package
            'hypothesis>=6.80',
            'mcap-ros2-support>=0.5',  # a second opinion on the bags that are written
            'mypy>=1.8',
            'pytest>=7.4',
            'pytest-xdist>=3.5',
            'ruff>=0.5',
            'scikit-image>=0.22',
            'torch>=2.2',  # the reference of the renderer and of LPIPS
            'types-PyYAML',
            'types-tqdm',
        ],
    },
    entry_points={
        'console_scripts': [
            'dcgs = dcgs_ros.cli.main:main',
            'mapper = dcgs_ros.nodes.start:mapper',
            'replay = dcgs_ros.nodes.start:replay',
            'tracker = dcgs_ros.nodes.start:tracker',
        ],
    },
)
