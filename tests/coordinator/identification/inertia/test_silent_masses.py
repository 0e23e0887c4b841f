"""Masses that no torque depends on are those of the modules' make, and right within their claim.

The torques of every shipped robot, computed with bodies that only the simulator knows, by sensors whose
scales are 2 % off, are fitted with a chain whose axes are 2 mrad off and points 1 mm off.
"""

import numpy as np
import pytest
from numpy.random import default_rng

from coordinator.dynamics.inertia_prior import module_prior
from coordinator.identification.inertia.robot_bodies import RobotBodies, robot_bodies
from coordinator.parameter_fit.least_squares import solve_information
from coordinator.parameter_fit.physically_consistent import MAX_COST, fit_physical
from coordinator.parameter_fit.systematic_errors import chain_effects, scale_effects
from coordinator.parameter_fit.torque_sensor_scale import TorqueScale
from module_agent.model.information import compress
from module_agent.model.perturbation import apply_perturbation
from module_agent.model.regressor import PER_BODY, inverse_dynamics, torque_regressor
from module_agent.signals.filtering import JointMotion
from sim.robot.robot_file import load_robot, shipped_robots
from sim.robot.robot_tree import build_tree, true_chain, true_inertia

SCALE, ANGLE_RAD, PLACE_M, NOISE_NM = 0.02, 2e-3, 1e-3, 0.005


def fitted(name: str, seed: int = 3) -> tuple[RobotBodies, float]:
    """Return a robot's bodies, and the relative torque error of those that ignore systematic errors."""
    robot, rng = load_robot(name), default_rng(seed)
    true, types = true_chain(robot), build_tree(robot).types
    joints = len(true.serials)
    q, qd, qdd = rng.uniform(-1.0, 1.0, (3, 600, joints)) * np.array([3.0, 2.0, 10.0])[:, None, None]
    tau = inverse_dynamics(true, true_inertia(robot), q, qd, qdd)
    tau = tau * (1.0 + SCALE * rng.normal(size=joints)) + NOISE_NM * rng.normal(size=tau.shape)
    sigma = np.tile(np.repeat([ANGLE_RAD, PLACE_M], 3), joints)
    chain = apply_perturbation(true, sigma * rng.normal(size=sigma.size))
    rows = torque_regressor(chain, q, qd, qdd)
    plain = compress(rows, tau)
    least_squares = solve_information(plain)
    motion = JointMotion(np.arange(len(q), dtype=np.int64), q, qd, qdd, tau)
    effects = chain_effects(chain, np.diag(sigma**2), least_squares.phi, motion)
    both = compress(np.concatenate([rows, effects], axis=2), tau)
    size = PER_BODY * joints
    information = [piece._replace(r=piece.r[:, :size]) for piece in both]
    scale = scale_effects(information, TorqueScale(np.zeros(joints), SCALE**2 * np.eye(joints)))
    shared = [np.hstack([own, piece.r[:, size:]]) for own, piece in zip(scale, both, strict=True)]
    ignoring = fit_physical(information, module_prior(chain, types), least_squares)
    return robot_bodies(information, chain, types, least_squares, 1.0, shared), ignoring.error


@pytest.mark.parametrize("name", shipped_robots())
def test_every_mass_is_sensible_and_within_its_claim(name: str) -> None:
    bodies, ignoring = fitted(name)
    assert bodies.fit is not None
    masses = bodies.fit.phi[::PER_BODY]
    sigma = np.sqrt(np.diagonal(bodies.fit.covariance))[::PER_BODY]
    true = true_inertia(load_robot(name))[:, 0]
    assert (np.abs(masses - true) < 3.0 * sigma).all()
    # Catalogue and links are a factor of two off at most; a claim of everything would be no claim.
    assert ((masses > true / 2.5) & (masses < 2.5 * true)).all()
    assert (sigma < true).all()
    # Sensible masses cost nothing of what the files are for; where noise is most of the error, 2 % of it.
    assert bodies.fit.error < 1.02 * ignoring + MAX_COST
