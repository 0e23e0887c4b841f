"""Bodies that can exist explain the torques as well as any parameters; what torques hide, the prior says."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.random import Generator, default_rng
from scipy.optimize import minimize

from coordinator.description.urdf_writer import write_urdf
from coordinator.dynamics.inertia_prior import module_prior
from coordinator.dynamics.pseudo_inertia import is_consistent, parameter_transform, parameters, pseudo_inertia
from coordinator.parameter_fit.base_parameters import base_parameters, inertial_columns, whitened
from coordinator.parameter_fit.least_squares import InertialFit, solve_information
from coordinator.parameter_fit.physically_consistent import (
    MAX_COST,
    WEIGHTS,
    NotSolvedError,
    PhysicalFit,
    fit_physical,
    physically_consistent,
)
from coordinator.parameter_fit.spectrum import UndeterminedError
from coordinator.parameter_fit.systematic_errors import scale_effects
from coordinator.parameter_fit.torque_sensor_scale import TorqueScale
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.information import JointInformation, gather
from module_agent.model.regressor import inverse_dynamics, torque_regressor
from sim.robot.random_robot import random_robot
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import build_tree, true_chain, true_inertia
from tests.breadth import breadth

ROBOTS = Path(__file__).resolve().parents[3] / "sim" / "robots"
STEP_S = 0.004


class Case:
    """A robot of the simulator, what its joints felt on a motion, and what is made of it."""

    def __init__(self, robot: Robot, noise_nm: float, seed: int, coulomb_nm: float = 0.0):
        self.rng = default_rng(seed)
        self.chain, self.truth = true_chain(robot), true_inertia(robot).ravel()
        self.prior = module_prior(self.chain, build_tree(robot).types)
        signals = self.motion(2000)
        tau = inverse_dynamics(self.chain, self.truth, *signals) + coulomb_nm * np.sign(signals[1])
        tau += noise_nm * self.rng.normal(size=tau.shape)
        self.information: tuple[JointInformation, ...] = gather(self.chain, *signals, tau)
        self.least_squares: InertialFit = solve_information(self.information)
        joints = len(self.chain.serials)
        self.sigma = np.full(joints, np.sqrt(np.mean(self.least_squares.torque_sigma_nm**2)))
        self.fit: PhysicalFit = fit_physical(self.information, self.prior, self.least_squares)

    def motion(self, samples: int) -> tuple[Array, Array, Array]:
        """Draw a smooth motion: five sines of up to 1.5 Hz a joint, 0.3 rad each."""
        t = STEP_S * np.arange(samples)
        size = (len(self.chain.serials), 5)
        omega = 2.0 * np.pi * self.rng.uniform(0.1, 1.5, size)
        amplitude = 0.3 * self.rng.normal(size=size)
        angle = omega[:, :, None] * t + self.rng.uniform(0.0, 2.0 * np.pi, size)[:, :, None]

        def summed(factor: Array, wave: Array) -> Array:
            return np.asarray((factor[:, :, None] * wave).sum(axis=1).T)

        return (
            summed(amplitude, np.sin(angle)),
            summed(amplitude * omega, np.cos(angle)),
            summed(-amplitude * omega**2, np.sin(angle)),
        )

    def held_out_errors(self, *guesses: Array) -> list[float]:
        """Return the relative torque errors of some parameters on another motion, without noise."""
        signals = self.motion(1500)
        tau = inverse_dynamics(self.chain, self.truth, *signals)
        errors = [inverse_dynamics(self.chain, phi, *signals) - tau for phi in guesses]
        return [float(np.linalg.norm(e) / np.linalg.norm(tau)) for e in errors]


def robot_named(name: str) -> Robot:
    return random_robot(int(name)) if name.isdigit() else load_robot(ROBOTS / f"{name}.toml")


@pytest.fixture(scope="module")
def arm() -> Case:
    return Case(robot_named("a2085_04"), 0.05, 4)


@pytest.mark.parametrize("name", ["a2085_04", "3", "11", *breadth("arm6", "7")])
def test_the_mass_matrix_of_the_written_robot_is_positive_in_ten_thousand_poses(
    name: str, tmp_path: Path
) -> None:
    case = Case(robot_named(name), 0.1, 1)
    write_urdf(tmp_path / "robot.urdf", case.chain, case.fit.phi)
    assert "nearest real body" not in (tmp_path / "robot.urdf").read_text()
    # Pinocchio counts joints in its own order, which a set of all angles does not mind.
    model = pin.buildModelFromUrdf(str(tmp_path / "robot.urdf"))
    data = model.createData()
    angles = case.rng.uniform(-np.pi, np.pi, (10_000, len(case.chain.serials)))
    poses = np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(len(angles), -1)
    upper = np.stack([pin.crba(model, data, q).copy() for q in poses])
    mass = np.triu(upper) + np.triu(upper, 1).transpose(0, 2, 1)
    assert np.linalg.eigvalsh(mass).min() > 0.0
    physical, plain = case.held_out_errors(case.fit.phi, case.least_squares.phi)
    assert physical < plain + 1e-3


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 400), noise_nm=st.floats(0.001, 1.0), coulomb_nm=st.sampled_from([0.0, 0.3]))
def test_real_bodies_predict_as_well_as_least_squares(seed: int, noise_nm: float, coulomb_nm: float) -> None:
    case = Case(random_robot(seed), noise_nm, seed, coulomb_nm)
    assert all(is_consistent(pseudo) for pseudo in case.fit.pseudo)
    physical, plain = case.held_out_errors(case.fit.phi, case.least_squares.phi)
    # Where least squares predicts worse than no model at all, noise decides which of the two is worse.
    assume(plain < 1.0)
    # Noise errs in both, and the constraint moves it: where it is most of the error, by part of it.
    assert physical < 1.5 * plain + 1e-3


def test_least_squares_alone_makes_no_real_bodies_here(arm: Case) -> None:
    # Otherwise the tests above would say nothing.
    bodies = arm.least_squares.phi.reshape(-1, 10)
    assert not any(is_consistent(pseudo_inertia(phi)) for phi in bodies)


def test_where_torques_tell_something_the_prior_does_not(arm: Case) -> None:
    columns = inertial_columns(4)
    found = base_parameters(*whitened(arm.information, arm.sigma), columns, max_sigma=0.3)
    pulls = (found.grouping @ (arm.fit.phi - arm.truth)) / found.sigma
    # The prior narrows the scatter, and pulls what the data hardly tell by less than their noise.
    assert np.abs(pulls).max() < 4.0
    off = (found.grouping @ (parameters_of(arm.prior) - arm.truth)) / found.sigma
    assert np.abs(off).max() > 100.0


def parameters_of(pseudo: Array) -> Array:
    return np.concatenate([parameters(one) for one in pseudo])


def test_without_data_the_bodies_are_the_priors(arm: Case) -> None:
    nothing = physically_consistent(np.zeros((1, 40)), np.zeros(1), arm.prior, 1.0)
    np.testing.assert_allclose(nothing.x, parameters_of(arm.prior), atol=1e-12)
    np.testing.assert_allclose(nothing.divergence, 0.0, atol=1e-12)


def test_no_other_solver_finds_better_bodies(rng: Generator) -> None:
    # Two bodies, few and noisy rows, so that prior and positivity matter; against a quasi-Newton search over
    # Cholesky factors with logarithms on their diagonals, where every point is a real body.
    prior = np.stack([np.diag([0.02, 0.03, 0.01, 0.5]), np.diag([0.01, 0.02, 0.02, 0.3])])
    rows, target = 3.0 * rng.normal(size=(9, 20)), 3.0 * rng.normal(size=9)
    lower, diagonal = np.tril_indices(4), np.arange(4)
    found = physically_consistent(rows, target, prior, 0.1)

    def bodies(logs: Array) -> Array:
        factors = np.zeros((2, 4, 4))
        factors[:, lower[0], lower[1]] = logs.reshape(2, 10)
        factors[:, diagonal, diagonal] = np.exp(factors[:, diagonal, diagonal])
        return np.asarray(factors @ factors.transpose(0, 2, 1))

    def objective(made: Array) -> float:
        ratio = np.linalg.solve(prior, made)
        trace = np.trace(ratio, axis1=1, axis2=2)
        divergence = trace - np.linalg.slogdet(ratio)[1] - 4.0
        return float(0.5 * np.sum((rows @ parameters_of(made) - target) ** 2) + 0.1 * divergence.sum())

    start = np.sqrt(prior)
    start[:, diagonal, diagonal] = np.log(start[:, diagonal, diagonal])
    search = minimize(
        lambda logs: objective(bodies(logs)),
        start[:, lower[0], lower[1]].ravel(),
        options={"maxiter": 5000, "gtol": 1e-6},
    )
    ours = objective(np.stack([pseudo_inertia(phi) for phi in found.x.reshape(2, 10)]))
    assert objective(prior) > 2.0 * ours
    # The search takes gradients by differences of 1e-8: it stops as near as this.
    assert ours == pytest.approx(float(search.fun), rel=1e-5)
    np.testing.assert_allclose(parameters_of(bodies(search.x)), found.x, atol=1e-3)
    np.testing.assert_allclose(found.divergence.sum() * 0.1, ours - 0.5 * misfit(rows, found.x, target))


def misfit(rows: Array, x: Array, target: Array) -> float:
    return float(np.sum((rows @ x - target) ** 2))


def test_the_bodies_do_not_depend_on_where_the_root_frame_stands(arm: Case) -> None:
    turn = np.linalg.qr(default_rng(5).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, [0.4, -0.7, 0.2]
    there = np.kron(np.eye(4), parameter_transform(pose))
    rows, target = whitened(arm.information, arm.sigma)
    here = physically_consistent(rows, target, arm.prior, 1.0)
    moved = physically_consistent(rows @ np.linalg.inv(there), target, pose @ arm.prior @ pose.T, 1.0)
    np.testing.assert_allclose(moved.x, there @ here.x, atol=1e-6)
    np.testing.assert_allclose(moved.divergence, here.divergence, rtol=1e-5)


def cost(fit: PhysicalFit) -> float:
    return fit.error - fit.least_squares_error


def test_a_prior_that_is_far_off_gives_way(arm: Case) -> None:
    # A tenth of the mass, a quarter of a metre from where it is.
    pose = np.eye(4)
    pose[:3, 3] = [0.15, -0.15, 0.15]
    wrong = 0.1 * pose @ arm.prior @ pose.T
    fit = fit_physical(arm.information, wrong, arm.least_squares)
    assert cost(fit) <= 5e-4
    physical, plain = arm.held_out_errors(fit.phi, arm.least_squares.phi)
    assert physical < plain + 1e-3


def test_a_prior_is_weakened_until_it_costs_little() -> None:
    # It takes the robot for one of paper: every gram more is dear.
    arm = Case(robot_named("arm6"), 0.1, 2)
    light = 1e-3 * np.asarray(arm.prior)
    free = fit_physical(arm.information, light, arm.least_squares, max_cost=1.0)
    held = fit_physical(arm.information, light, arm.least_squares)
    assert free.weight == WEIGHTS[0]
    assert cost(free) > 5e-4
    assert held.weight < free.weight
    # Of 3 % noise in the torques least squares has fitted some: that is allowed on top.
    assert cost(held) < 2e-3 < cost(free)


def test_torques_without_noise_give_the_same_robot_as_least_squares() -> None:
    case = Case(robot_named("arm6"), 0.0, 3)
    assert all(is_consistent(pseudo) for pseudo in case.fit.pseudo)
    physical, plain = case.held_out_errors(case.fit.phi, case.least_squares.phi)
    assert plain < 1e-9
    assert physical < 1e-5


def test_friction_that_nobody_modelled_makes_no_impossible_bodies() -> None:
    case = Case(robot_named("arm6"), 0.02, 3, coulomb_nm=0.3)
    assert all(is_consistent(pseudo) for pseudo in case.fit.pseudo)
    physical, plain = case.held_out_errors(case.fit.phi, case.least_squares.phi)
    assert physical < plain + 1e-3


def test_friction_beside_the_bodies_needs_no_prior(arm: Case) -> None:
    signals = arm.motion(400)
    friction = np.array([0.1, 0.2, 0.3, 0.4])
    tau = inverse_dynamics(arm.chain, arm.truth, *signals) + signals[1] * friction
    viscous = signals[1][:, :, None] * np.eye(4)
    rows = np.concatenate([torque_regressor(arm.chain, *signals), viscous], axis=2).reshape(-1, 44)
    found = physically_consistent(rows / 0.01, tau.ravel() / 0.01, arm.prior, 1e-3)
    np.testing.assert_allclose(found.x[40:], friction, atol=1e-3)


def test_the_covariance_is_that_of_least_squares_where_the_data_rule(arm: Case) -> None:
    # With so little noise even a flange of 30 g is told, and the prior adds nothing.
    exact = Case(robot_named("a2085_04"), 1e-4, 4)
    rows, target = whitened(exact.information, exact.sigma)
    found = base_parameters(rows, target, inertial_columns(4), max_sigma=0.3)
    free = physically_consistent(rows, target, exact.prior, WEIGHTS[0])
    spread = found.grouping @ free.covariance @ found.grouping.T
    np.testing.assert_allclose(np.sqrt(np.diagonal(spread)), found.sigma, rtol=0.05)
    # With the prior every parameter is bounded, those too of which torques show nothing.
    assert np.isfinite(arm.fit.covariance).all()
    assert (np.diagonal(arm.fit.covariance) > 0.0).all()


def test_a_torque_sensor_of_unknown_scale_makes_the_bodies_as_uncertain(arm: Case) -> None:
    columns = inertial_columns(4)
    scale = TorqueScale(np.zeros(len(arm.information)), 0.05**2 * np.eye(len(arm.information)))
    effects = scale_effects(arm.information, scale)
    wide = fit_physical(arm.information, arm.prior, arm.least_squares, effects=effects)
    assert wide.error < arm.fit.error + MAX_COST
    found = base_parameters(*whitened(arm.information, arm.sigma), columns, max_sigma=0.3)
    spread = found.grouping @ wide.covariance @ found.grouping.T
    relative = np.sqrt(np.diagonal(spread)) / np.abs(found.value)
    # What a joint feels by itself is off by as much as its sensor; the noise is far less.
    largest = np.argsort(-np.abs(found.value))[:3]
    assert (relative[largest] > 0.02).all()
    assert (relative[largest] < 0.1).all()
    assert (np.diagonal(wide.covariance) >= np.diagonal(arm.fit.covariance)).all()


def test_what_does_not_fit_is_named(arm: Case) -> None:
    with pytest.raises(ValueError, match=r"rows \(3, 40\), target \(2,\)"):
        physically_consistent(np.zeros((3, 40)), np.zeros(2), arm.prior, 1.0)
    with pytest.raises(ValueError, match="30 columns for 4 bodies"):
        physically_consistent(np.zeros((3, 30)), np.zeros(3), arm.prior, 1.0)
    with pytest.raises(ValueError, match="weight is 0"):
        physically_consistent(np.zeros((3, 40)), np.zeros(3), arm.prior, 0.0)
    with pytest.raises(DataError, match="a body of the prior cannot exist"):
        physically_consistent(np.zeros((3, 40)), np.zeros(3), -arm.prior, 1.0)
    with pytest.raises(NotSolvedError, match="the rows may not determine the parameters"):
        physically_consistent(np.zeros((3, 41)), np.zeros(3), arm.prior, 1.0)
    still = tuple(JointInformation(p.r, np.zeros_like(p.z), 0.0, p.samples) for p in arm.information)
    with pytest.raises(UndeterminedError, match="all torques are zero"):
        fit_physical(still, arm.prior, arm.least_squares)
    assert not any(array.flags.writeable for array in arm.fit if isinstance(array, np.ndarray))
