# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Dual Covariance Gaussian Splatting SLAM for ROS 2."""

__version__ = '0.1.0'
