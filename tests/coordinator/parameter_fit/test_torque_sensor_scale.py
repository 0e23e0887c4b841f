"""Torque sensors that are off in scale contradict each other, which tells by how much, but for all alike."""

import numpy as np
import pytest
from numpy.random import Generator

from coordinator.parameter_fit.instrumental_variables import InstrumentalFit, solve_instrumental_variables
from coordinator.parameter_fit.least_squares import solve_information
from coordinator.parameter_fit.torque_sensor_scale import TorqueScale, known_scale, refine_scale, scaled
from module_agent.model.chain import Array
from module_agent.model.information import compress
from module_agent.model.regressor import torque_regressor
from module_agent.signals.torque_terms import READING_TERMS
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain, true_inertia

ROBOT = load_robot("a2085_04")
CHAIN, PHI = true_chain(ROBOT), true_inertia(ROBOT).ravel()
JOINTS, SIGMA_NM, PRIOR = 4, 0.01, 0.05


def solved(rng: Generator, off: Array, prior: float = PRIOR) -> InstrumentalFit:
    """Fit 2000 samples at random, read by sensors that show tau / (1 + off)."""
    signals = rng.uniform(-1.0, 1.0, (3, 2000, JOINTS)) * np.array([3.0, 2.0, 10.0])[:, None, None]
    rigid = torque_regressor(CHAIN, *signals)
    tau = rigid @ PHI / (1.0 + off) + SIGMA_NM * rng.normal(size=(2000, JOINTS))
    nothing = np.zeros((2000, JOINTS, len(READING_TERMS)))
    return solve_instrumental_variables(
        compress(np.concatenate([rigid, nothing], axis=2), tau), np.zeros_like(PHI), 1.0, prior
    )


def test_sensors_that_disagree_are_put_right_relative_to_each_other(rng: Generator) -> None:
    off = np.array([0.04, -0.03, 0.02, 0.0])
    found = solved(rng, off)
    # The last joint carries next to nothing: its sensor says nothing of the others.
    apart = (found.scale.value - off)[:3]
    assert np.ptp(apart) < 3e-3
    # What they have in common stays as uncertain as three sensors leave it.
    assert found.scale.sigma[:3] == pytest.approx(PRIOR / np.sqrt(3.0), rel=0.05)
    assert abs(apart.mean()) < 4.0 * PRIOR / np.sqrt(3.0)
    # Put right, the joints agree on the bodies: noise is all that is left.
    np.testing.assert_allclose(found.fit.torque_sigma_nm, SIGMA_NM * (1.0 + found.scale.value), rtol=0.05)


def test_the_common_scale_does_not_drift_away_with_the_noise(rng: Generator) -> None:
    """Readings that are scaled down bring the noise down with them: that must not pass for a better fit."""
    found = solved(rng, np.zeros(JOINTS))
    assert np.abs(found.scale.value).max() < 3e-3


def test_intervals_of_relative_scales_cover(rng: Generator) -> None:
    pulls = []
    for _ in range(30):
        off = np.array([*(0.03 * rng.normal(size=3)), 0.0])
        found = solved(rng, off).scale
        contrast = np.array([1.0, -0.5, -0.5, 0.0])
        # In logarithms, as scales multiply: what all have in common then drops out.
        error = contrast @ (np.log1p(found.value) - np.log1p(off))
        pulls.append(error / np.sqrt(contrast @ found.covariance @ contrast))
    # The rms of 30 normal numbers is between these in 99.8 of 100 cases.
    assert 0.61 < np.sqrt(np.mean(np.square(pulls))) < 1.41


def test_sensors_that_are_known_are_left_alone(rng: Generator) -> None:
    found = solved(rng, np.array([0.04, -0.03, 0.02, 0.0]), prior=0.0)
    np.testing.assert_array_equal(found.scale.value, 0.0)
    np.testing.assert_array_equal(found.scale.covariance, 0.0)


def test_scaled_rows_are_those_of_scaled_torques(rng: Generator) -> None:
    regressor, tau = rng.normal(size=(30, 1, 10)), rng.normal(size=(30, 1))
    (plain,), (larger,) = compress(regressor, tau), compress(regressor, 1.3 * tau)
    found = scaled(plain, 0.3)
    np.testing.assert_allclose(found.r.T @ found.z, larger.r.T @ larger.z, rtol=1e-12)
    assert found.rest == pytest.approx(larger.rest, rel=1e-12)


def test_the_root_of_a_covariance_is_one(rng: Generator) -> None:
    half = rng.normal(size=(3, 3))
    scale = TorqueScale(np.zeros(3), half @ half.T)
    np.testing.assert_allclose(scale.root @ scale.root.T, scale.covariance, rtol=1e-10, atol=1e-12)


def test_bodies_that_torques_hardly_show_are_not_taken_for_scales(rng: Generator) -> None:
    """Axes 3 mrad off parallel show further parameters; their torques are no evidence about the scales."""
    robot = load_robot("a2085_06")
    chain, phi = true_chain(robot), true_inertia(robot).ravel()
    joints, noise = 6, 1e-4 * np.array([30.0, 30.0, 20.0, 3.0, 2.0, 2.0])
    axis = chain.axis + 3e-3 * rng.normal(size=(joints, 3))
    chain = chain._replace(axis=axis / np.linalg.norm(axis, axis=1, keepdims=True))
    signals = rng.normal(size=(3, 2000, joints)) * np.array([1.0, 1.0, 4.0])[:, None, None]
    rigid = torque_regressor(chain, *signals)
    rows = compress(rigid, rigid @ phi + noise * rng.normal(size=(2000, joints)))
    fit = solve_information(rows, 1.0 / noise, max_sigma_kg=np.inf)
    assert fit.rank == 38
    scale = refine_scale(rows, fit, noise, PRIOR, known_scale(joints), 1.0)
    assert (np.abs(scale.value) < 3.0 * scale.sigma).all()
