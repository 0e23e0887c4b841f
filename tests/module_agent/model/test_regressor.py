"""Torque regressor: against pinocchio on random trees, and against what mechanics says of simple robots."""

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import Generator, default_rng
from scipy.spatial.transform import Rotation

from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.forward_kinematics import body_displacements
from module_agent.model.regressor import (
    PER_BODY,
    RegressorStream,
    gram_matrix,
    inverse_dynamics,
    regressor_chunks,
    torque_regressor,
)

# Pinocchio's order of a body's dynamic parameters: m, mc, Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
PIN_ORDER = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]


def random_chain(rng: Generator, joints: int, *, serial_chain: bool = False) -> Chain:
    axis = rng.normal(size=(joints, 3))
    home = np.tile(np.eye(4), (joints, 1, 1))
    home[:, :3, :3] = Rotation.random(joints, rng=rng).as_matrix()
    home[:, :3, 3] = rng.uniform(-1.0, 1.0, (joints, 3))
    return Chain(
        serials=tuple(f"M{i}" for i in range(joints)),
        parent=tuple(i - 1 if serial_chain else int(rng.integers(-1, i)) for i in range(joints)),
        reversed=tuple(bool(r) for r in rng.integers(0, 2, joints)),
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        point=rng.uniform(-1.0, 1.0, (joints, 3)),
        imu_home=home,
        gravity=Rotation.random(rng=rng).apply([0.0, 0.0, 9.81]),
    )


def pinocchio_model(chain: Chain) -> pin.Model:
    """Joint frames parallel to the root frame at q = 0, their origins on the axes."""
    model = pin.Model()
    model.gravity.linear = -chain.gravity
    for i, parent in enumerate(chain.parent):
        below = np.zeros(3) if parent < 0 else chain.point[parent]
        placement = pin.SE3(np.eye(3), chain.point[i] - below)
        joint = pin.JointModelRevoluteUnaligned(chain.axis[i])
        model.addJoint(parent + 1, joint, placement, chain.serials[i])
    return model


def root_inertia(mass: float, com: Array, about_com: Array, at: Array) -> tuple[Array, pin.Inertia]:
    """One rigid body as ten parameters about the root origin, and for pinocchio about `at`."""
    about_root = about_com + mass * (com @ com * np.eye(3) - np.outer(com, com))
    upper = about_root[np.triu_indices(3)]
    return np.concatenate([[mass], mass * com, upper]), pin.Inertia(mass, com - at, about_com)


def random_bodies(rng: Generator, chain: Chain) -> tuple[Array, list[pin.Inertia]]:
    phi, inertias = [], []
    for point in chain.point:
        shape = rng.normal(size=(3, 3)) * 0.05
        mass_spread = shape @ shape.T
        about_com = np.trace(mass_spread) * np.eye(3) - mass_spread  # any positive mass distribution
        one, other = root_inertia(rng.uniform(0.1, 1.0), rng.uniform(-1.0, 1.0, 3), about_com, point)
        phi.append(one)
        inertias.append(other)
    return np.concatenate(phi), inertias


def random_motion(rng: Generator, samples: int, joints: int) -> tuple[Array, Array, Array]:
    q, qd, qdd = rng.uniform(-3.0, 3.0, (3, samples, joints))
    return q, qd, 5.0 * qdd


def assert_close(found: Array, expected: Array, relative: float) -> None:
    assert np.abs(found - expected).max() < relative * np.abs(expected).max()


@pytest.mark.parametrize(("joints", "seed"), [(1, 0), (2, 1), (7, 2), (7, 3), (12, 4)])
def test_torques_equal_pinocchios_recursive_newton_euler(joints: int, seed: int) -> None:
    rng = default_rng(seed)
    chain = random_chain(rng, joints)
    phi, inertias = random_bodies(rng, chain)
    model = pinocchio_model(chain)
    for i, inertia in enumerate(inertias):
        model.appendBodyToJoint(i + 1, inertia, pin.SE3.Identity())
    data = model.createData()
    q, qd, qdd = random_motion(rng, 20, joints)
    expected = np.array(
        [pin.rnea(model, data, _pin_q(model, a), b, c) for a, b, c in zip(q, qd, qdd, strict=True)]
    )
    assert_close(inverse_dynamics(chain, phi, q, qd, qdd), expected, 1e-12)


@settings(max_examples=40, deadline=None)
@given(joints=st.integers(1, 12), seed=st.integers(0, 2**32 - 1), serial_chain=st.booleans())
def test_the_matrix_equals_pinocchios_column_by_column(joints: int, seed: int, serial_chain: bool) -> None:
    rng = default_rng(seed)
    chain = random_chain(rng, joints, serial_chain=serial_chain)
    # Whole groups of samples, and a remainder.
    motion = random_motion(rng, 19, joints)
    assert_equals_pinocchio(chain, torque_regressor(chain, *motion), *motion)


@pytest.mark.parametrize("q_rad", [1e4, 9.9e4, 1.1e5, 1e9])
def test_positions_many_turns_away_are_as_exact(rng: Generator, q_rad: float) -> None:
    chain = random_chain(rng, 3)
    q, qd, qdd = random_motion(rng, 5, 3)
    q[1] += q_rad
    q[3, 1] -= q_rad
    assert_equals_pinocchio(chain, torque_regressor(chain, q, qd, qdd), q, qd, qdd)


@settings(max_examples=30, deadline=None)
@given(joints=st.integers(1, 9), samples=st.integers(1, 40), seed=st.integers(0, 2**32 - 1))
def test_a_sample_has_the_same_bits_wherever_it_is_calculated(joints: int, samples: int, seed: int) -> None:
    rng = default_rng(seed)
    chain = random_chain(rng, joints)
    motion = random_motion(rng, samples, joints)
    whole = torque_regressor(chain, *motion)
    stream = RegressorStream(chain)
    for k in range(samples):
        assert (stream.rows(*(signal[k] for signal in motion)) == whole[k]).all()
        assert (torque_regressor(chain, *(signal[k : k + 3] for signal in motion)) == whole[k : k + 3]).all()
    assert (torque_regressor(chain, *motion, threads=3) == whole).all()
    for part, rows in regressor_chunks(chain, *motion):
        assert (rows == whole[part]).all()


def test_chunks_of_a_long_motion_follow_on_one_another_in_the_same_memory(rng: Generator) -> None:
    chain = random_chain(rng, 7)
    motion = random_motion(rng, 700, 7)
    whole = torque_regressor(chain, *motion)
    ends, places = [0], set()
    for part, rows in regressor_chunks(chain, *motion):
        assert part.start == ends[-1]
        ends.append(part.stop)
        places.add(rows.__array_interface__["data"][0])
        assert not rows.flags.writeable
        assert (rows == whole[part]).all()
    assert ends[-1] == 700
    assert len(ends) > 2
    assert len(places) == 1


def test_results_are_written_where_the_caller_wants_them(rng: Generator) -> None:
    chain = random_chain(rng, 4)
    motion = random_motion(rng, 33, 4)
    out = np.zeros((50, 4, 40))
    torque_regressor(chain, *random_motion(rng, 50, 4), out=out)
    again = torque_regressor(chain, *motion, out=out[:33])
    assert np.shares_memory(again, out)
    assert not again.flags.writeable
    assert out.flags.writeable
    assert (again == torque_regressor(chain, *motion)).all()


def test_an_array_that_cannot_take_the_result_is_refused(rng: Generator) -> None:
    chain = random_chain(rng, 3)
    motion = random_motion(rng, 4, 3)
    with pytest.raises(
        ValueError, match=r"out is float64 \(4, 3, 20\); this motion needs float64 \(4, 3, 30\)"
    ):
        torque_regressor(chain, *motion, out=np.zeros((4, 3, 20)))
    with pytest.raises(ValueError, match="out is float32"):
        torque_regressor(chain, *motion, out=np.zeros((4, 3, 30), dtype=np.float32))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="not contiguous"):
        torque_regressor(chain, *motion, out=np.zeros((4, 3, 60))[..., ::2])
    fixed = np.zeros((4, 3, 30))
    fixed.flags.writeable = False
    with pytest.raises(ValueError, match="cannot be written to"):
        torque_regressor(chain, *motion, out=fixed)
    with pytest.raises(ValueError, match="out is not zero where a joint does not carry a body"):
        torque_regressor(chain, *motion, out=np.ones((4, 3, 30)))


def test_the_gram_matrix_is_that_of_the_weighted_rows(rng: Generator) -> None:
    chain = random_chain(rng, 7)
    motion = random_motion(rng, 600, 7)
    weights = rng.uniform(0.1, 2.0, 7)
    rows = (torque_regressor(chain, *motion) * np.sqrt(weights)[:, None]).reshape(-1, 70)
    assert_close(gram_matrix(chain, *motion, weights), rows.T @ rows, 1e-12)


def assert_equals_pinocchio(chain: Chain, ours: Array, q: Array, qd: Array, qdd: Array) -> None:
    model = pinocchio_model(chain)
    data = model.createData()
    joints = len(chain.serials)
    to_joint = [_shift(point) for point in chain.point]
    for k in range(q.shape[0]):
        theirs = np.atleast_2d(
            pin.computeJointTorqueRegressor(model, data, _pin_q(model, q[k]), qd[k], qdd[k])
        )
        blocks = [theirs[:, 10 * j : 10 * j + 10][:, PIN_ORDER] @ to_joint[j] for j in range(joints)]
        assert_close(ours[k], np.hstack(blocks), 1e-12)


def _pin_q(model: pin.Model, q: Array) -> Array:
    """Plain revolute joints: pinocchio's configuration is q itself."""
    assert model.nq == q.size
    return q


def _shift(point: Array) -> Array:
    """Matrix from parameters about the root origin to those about `point` (axes parallel); linear in phi."""
    found = np.empty((PER_BODY, PER_BODY))
    for k, unit in enumerate(np.eye(PER_BODY)):
        mass, first, inertia = unit[0], unit[1:4], np.zeros((3, 3))
        inertia[np.triu_indices(3)] = unit[4:]
        inertia = np.triu(inertia) + np.triu(inertia, 1).T
        moved = first - mass * point
        # I_p = I_0 - 2 (mc . p) 1 + (mc p^T + p mc^T) + m (p . p 1 - p p^T)
        about = inertia - 2.0 * first @ point * np.eye(3) + np.outer(first, point) + np.outer(point, first)
        about += mass * (point @ point * np.eye(3) - np.outer(point, point))
        found[:, k] = np.concatenate([[mass], moved, about[np.triu_indices(3)]])
    return found


@settings(max_examples=30, deadline=None)
@given(joints=st.integers(1, 9), seed=st.integers(0, 2**32 - 1))
def test_a_joint_feels_only_the_bodies_it_carries(joints: int, seed: int) -> None:
    rng = default_rng(seed)
    chain = random_chain(rng, joints)
    y = torque_regressor(chain, *random_motion(rng, 3, joints))
    for i in range(joints):
        carried = chain.descendants(i)
        for j in range(joints):
            block = y[:, i, PER_BODY * j : PER_BODY * (j + 1)]
            assert bool(np.any(block)) == (j in carried)


def test_at_rest_the_torque_holds_the_gradient_of_potential_energy(rng: Generator) -> None:
    chain = random_chain(rng, 5)
    phi, _ = random_bodies(rng, chain)
    q = rng.uniform(-3.0, 3.0, (4, 5))

    def energy(at: Array) -> Array:
        moved = body_displacements(chain, at)
        masses = phi.reshape(5, 10)
        centres = np.einsum("mnij,nj->mni", moved[..., :3, :3], masses[:, 1:4])
        centres = centres + moved[..., :3, 3] * masses[:, :1]
        return centres.sum(axis=1) @ chain.gravity

    step = 1e-6
    gradient = np.stack(
        [(energy(q + step * e) - energy(q - step * e)) / (2.0 * step) for e in np.eye(5)], axis=1
    )
    held = inverse_dynamics(chain, phi, q, np.zeros_like(q), np.zeros_like(q))
    # Central differences of step 1e-6 on energies of about 10 J: 1e-9 J / 1e-6 rad of rounding at worst.
    assert_close(held, gradient, 1e-7)


def test_the_power_of_the_joints_is_the_rate_of_the_energy_without_gravity(rng: Generator) -> None:
    chain = random_chain(rng, 4)._replace(gravity=np.zeros(3))
    phi, _ = random_bodies(rng, chain)
    rate, phase = rng.uniform(1.0, 3.0, 4), rng.uniform(0.0, 6.0, 4)
    t = np.linspace(0.0, 1.0, 2001)[:, None]
    q, qd, qdd = (
        np.sin(rate * t + phase),
        rate * np.cos(rate * t + phase),
        -(rate**2) * np.sin(rate * t + phase),
    )
    tau = inverse_dynamics(chain, phi, q, qd, qdd)
    still = np.zeros_like(qd)
    # Kinetic energy is half of qd . M(q) qd, and M(q) a is the torque of acceleration a out of rest.
    energy = 0.5 * np.sum(qd * inverse_dynamics(chain, phi, q, still, qd), axis=1)
    power = np.sum(tau * qd, axis=1)
    work = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(t[:, 0]))])
    # The trapezoidal rule with a step of 0.5 ms: h^2 / 12 times the second derivative, below 1e-5 of the
    # work.
    assert_close(work, energy - energy[0], 1e-5)


def test_an_arm_held_out_level_needs_mass_times_gravity_times_reach() -> None:
    chain = Chain(
        ("A",),
        (-1,),
        (False,),
        np.array([[0.0, -1.0, 0.0]]),
        np.zeros((1, 3)),
        np.eye(4)[None],
        np.array([0, 0, 9.81]),
    )
    phi = np.array([2.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.5])
    still = np.zeros((1, 1))
    assert inverse_dynamics(chain, phi, still, still, still) == pytest.approx(2.0 * 0.5 * 9.81)
    # Turned up by 90 degrees nothing is left but the inertia against acceleration.
    up = np.full((1, 1), np.pi / 2)
    assert inverse_dynamics(chain, phi, up, still, np.full((1, 1), 3.0)) == pytest.approx(0.5 * 3.0)


@settings(max_examples=30, deadline=None)
@given(joints=st.integers(1, 9), seed=st.integers(0, 2**32 - 1))
def test_the_torques_are_the_regressor_times_any_parameters(joints: int, seed: int) -> None:
    rng = default_rng(seed)
    chain = random_chain(rng, joints)
    phi = rng.normal(size=10 * joints)
    motion = random_motion(rng, 21, joints)
    rows = torque_regressor(chain, *motion)
    size = np.abs(rows) @ np.abs(phi)
    assert (np.abs(inverse_dynamics(chain, phi, *motion) - rows @ phi) <= 1e-12 * size.max()).all()


def test_results_cannot_be_written_to(rng: Generator) -> None:
    chain = random_chain(rng, 2)
    assert not torque_regressor(chain, *random_motion(rng, 2, 2)).flags.writeable
    assert not inverse_dynamics(chain, np.ones(20), *random_motion(rng, 2, 2)).flags.writeable


def test_wrong_shapes_and_values_are_named(rng: Generator) -> None:
    chain = random_chain(rng, 2)
    q, qd, qdd = random_motion(rng, 4, 2)
    with pytest.raises(ValueError, match=r"qd_rad_s has shape \(4, 1\)"):
        torque_regressor(chain, q, qd[:, :1], qdd)
    with pytest.raises(DataError, match="q_rad holds a value that is not finite"):
        torque_regressor(chain, np.full_like(q, np.nan), qd, qdd)
    with pytest.raises(ValueError, match="phi has 10 values; a chain of 2 joints needs 20"):
        inverse_dynamics(chain, np.ones(10), q, qd, qdd)
