# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Where up is, in closed form: in motion too, and told from the sensor's bias."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from dcgs_ros.core import se3
from dcgs_ros.core.config.schema import override
from dcgs_ros.core.config.stages import Config
from dcgs_ros.core.priors.gravity import Gravity, UpPrior
from dcgs_ros.core.priors.gyro import Gyro
from dcgs_ros.core.priors.motion_priors import MotionPriors
from dcgs_ros.core.priors.readings import AngularRate, SpecificForce
from dcgs_ros.core.tracking.factors import NormalEquations

MS = 1_000_000
FRAME_NS = 33_333_333
G = 9.81
RIG = se3.exp(np.array([0, 0, 0, 0.4, -1.2, 0.7]))[:3, :3]  # IMU to camera
T_WORLD_START = se3.exp(np.array([0, 0, 0, -1.3, 0.2, 0.1]))  # up is somewhere
Motion = Callable[[float], NDArray[np.float64]]


def at_rest(seconds: float) -> NDArray[np.float64]:
    return np.eye(4)


def swaying(seconds: float) -> NDArray[np.float64]:
    """Accelerations up to 1 m/s^2, turns up to 1 rad/s."""
    way = 0.25 * np.sin(2.0 * seconds + np.array([0.0, 1.0, 2.0]))
    return se3.exp(np.array([*way, *(0.5 * np.sin(2.0 * seconds + np.arange(3.0)))]))


def turning(seconds: float) -> NDArray[np.float64]:
    """About the vertical, once in six seconds."""
    return se3.exp(np.array([0, 0, 0, 0, 0, np.pi / 3.0 * seconds]))


class Rig:
    """A camera in a level world with its IMU, and the pose as a map has it that may tilt."""

    def __init__(self, motion: Motion, bias: tuple[float, ...] = (0.0, 0.0, 0.0)) -> None:
        gyro = Gyro(RIG)
        self.gyro, self.gravity = gyro, Gravity(RIG, gyro)
        self._motion, self._bias = motion, np.array(bias)

    def true(self, seconds: float) -> NDArray[np.float64]:
        return self._motion(seconds) @ T_WORLD_START

    def measure(self, ns: int) -> None:
        h, seconds = 1e-4, 1e-9 * ns
        before, now, after = (self.true(seconds + k * h) for k in (-1, 0, 1))
        acceleration = (before + after - 2 * now)[:3, 3] / h**2 + np.array([0, 0, G])
        force = now[:3, :3].T @ acceleration + self._bias
        rate = se3.log(se3.inverse(before) @ after)[3:] / (2 * h)
        self.gravity.sense(SpecificForce(ns, RIG.T @ force))
        self.gyro.sense(AngularRate(ns, RIG.T @ rate))

    def run(self, seconds: float, drift: Motion = at_rest) -> UpPrior:
        """Follow poses of a map that has tilted by `drift`; return the last prior."""
        for ns in range(0, round(seconds * 1e9), 5 * MS):
            self.measure(ns)
            if ns % FRAME_NS < 5 * MS and ns > FRAME_NS:
                self.at_ns = ns - ns % FRAME_NS - FRAME_NS  # readings are there before their frame
                at_s = 1e-9 * self.at_ns
                self.gravity.follow(self.at_ns, drift(at_s) @ self.true(at_s))
        prior = self.gravity.prior(self.at_ns)
        assert prior is not None
        return prior

    def off_deg(self, prior: UpPrior) -> float:
        """How far a pose is from the true one that has up where the prior has it."""
        T = self.true(1e-9 * self.at_ns)
        for _ in range(5):
            system = prior.normal_equations(T) + Unmoved(T).normal_equations(T)
            T = T @ se3.exp(system.step(0.0))
        off = se3.log(se3.inverse(self.true(1e-9 * self.at_ns)) @ T)
        np.testing.assert_allclose(off[:3], 0.0, atol=1e-12)  # it turns about where it is
        return float(np.degrees(np.linalg.norm(off[3:])))


class Unmoved:
    """So little that it only tells of what is left open."""

    def __init__(self, T: NDArray[np.float64]) -> None:
        self._T = T

    def normal_equations(self, T: NDArray[np.float64]) -> NormalEquations:
        xi = 1e-3 * se3.log(se3.inverse(T) @ self._T)
        return NormalEquations(1e-3 * np.eye(6), xi, float(xi @ xi))


def tilting(seconds: float) -> NDArray[np.float64]:
    """It drifts by 0.05 degrees a second."""
    return se3.exp(np.array([0, 0, 0, np.radians(0.05) * seconds, 0, 0]))


@pytest.mark.parametrize('motion', [at_rest, swaying])
@pytest.mark.parametrize('drift', [at_rest, tilting])
def test_up_is_where_it_was_whatever_the_map_does(motion: Motion, drift: Motion) -> None:
    """Accelerations that the poses explain are not taken for gravity."""
    rig = Rig(motion)
    prior = rig.run(10.0, drift)
    assert rig.off_deg(prior) < 0.15  # of 0.5 that the map has tilted
    assert prior.sigma_rad < np.radians(0.5)
    assert rig.gravity.reason(rig.at_ns) is None


def test_the_term_is_a_derivative() -> None:
    prior, T = Rig(swaying).run(3.0), se3.exp(np.full(6, 0.4))
    system, h = prior.normal_equations(T), 1e-6

    def cost(xi: NDArray[np.float64]) -> float:
        return prior.normal_equations(T @ se3.exp(xi)).cost

    slope = [(cost(h * axis) - cost(-h * axis)) / (2 * h) for axis in np.eye(6)]
    np.testing.assert_allclose(slope, -2.0 * np.asarray(system.g), rtol=1e-5, atol=1e-3)
    seen = T[:3, :3].T @ prior.up_world
    np.testing.assert_allclose(np.asarray(system.H)[3:, 3:] @ seen, 0.0, atol=1e-9)  # heading


def test_a_bias_is_told_from_a_tilt_by_turning() -> None:
    """Level in one direction, it would tilt the world by a degree in the other."""
    bias = (0.08, -0.05, 0.06)
    rig = Rig(turning, bias)
    assert rig.off_deg(rig.run(15.0)) < 0.2
    level = T_WORLD_START[:3, :3].T @ np.array([0, 0, 1.0])
    wrong = rig.gravity.bias - bias
    np.testing.assert_allclose(wrong - level * (level @ wrong), 0.0, atol=0.02)


def test_a_bias_of_a_camera_that_does_not_turn_is_no_tilt() -> None:
    rig = Rig(at_rest, (0.08, -0.05, 0.06))
    assert rig.off_deg(rig.run(5.0)) < 0.05


def test_the_gyro_carries_up_on_while_the_lens_is_covered() -> None:
    rig = Rig(swaying)
    rig.run(4.0)
    known_ns = rig.at_ns
    for ns in range(4000 * MS, 6000 * MS, 5 * MS):
        rig.measure(ns)
    rig.gravity.forget()
    rig.at_ns = 5990 * MS
    later, then = rig.gravity.prior(rig.at_ns), rig.gravity.prior(known_ns)
    assert later is not None and then is not None
    assert rig.off_deg(later) < 0.15
    assert later.sigma_rad > then.sigma_rad
    rig.gravity.follow(rig.at_ns, rig.true(5.99))
    again = rig.gravity.prior(rig.at_ns)
    assert again is not None
    np.testing.assert_allclose(again.up_cam, later.up_cam, atol=1e-9)


def test_forces_that_are_no_gravity_are_left_out() -> None:
    rig = Rig(at_rest, (0.0, 3.0, 0.0))
    with pytest.raises(AssertionError):
        rig.run(3.0)
    norm = np.linalg.norm(G * T_WORLD_START[:3, :3].T[:, 2] + (0.0, 3.0, 0.0))
    assert rig.gravity.reason(rig.at_ns) == f'looking for up: a mean force of {norm:.2f} m/s^2'


def test_a_wrongly_mounted_accelerometer_finds_no_up() -> None:
    """Turned with the camera, its force goes elsewhere than the gyro says."""
    rig = Rig(turning)
    rig.gravity._R_cam_imu = RIG @ se3.exp(np.array([0, 0, 0, 1.5, 0, 0]))[:3, :3]
    with pytest.raises(AssertionError):
        rig.run(6.0)
    reason = rig.gravity.reason(rig.at_ns)
    assert reason is not None and reason.startswith('looking for up: a mean force of 9.')


def test_silence_and_its_like_are_named() -> None:
    gyro = Gyro(np.eye(3))
    gravity = Gravity(np.eye(3), gyro)
    assert gravity.reason(0) == 'no reading yet'
    gravity.sense(SpecificForce(0, np.array([0, 0, G])))
    gyro.sense(AngularRate(0, np.zeros(3)))
    assert gravity.reason(0) == 'looking for up'
    assert gravity.reason(500 * MS) == 'no reading for 0.50 s'


def test_it_is_off_unless_asked_for_and_takes_the_gyro_along() -> None:
    assert MotionPriors(Config().priors, np.eye(3)).gravity is None
    priors = MotionPriors(override(Config().priors, {'gravity': True}), np.eye(3))
    priors.sense(SpecificForce(0, np.array([0, 0, G])))
    priors.sense(AngularRate(0, np.zeros(3)))
    assert priors.reasons(0) == {'gyro': 'used', 'gravity': 'looking for up'}
