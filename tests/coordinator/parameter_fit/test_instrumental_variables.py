"""Terms of the torque readings other than the bodies' torque are identified exactly where they are."""

import numpy as np
import pytest
from numpy.random import Generator, default_rng

from coordinator.parameter_fit.instrumental_variables import (
    InstrumentalFit,
    solve_instrumental_variables,
)
from coordinator.parameter_fit.significance import SIGNIFICANT_F
from module_agent.model.chain import Array, Chain
from module_agent.model.information import JointInformation, compress, merge
from module_agent.model.regressor import torque_regressor
from module_agent.signals.filtering import JointMotion, filtered_motion
from module_agent.signals.torque_terms import READING_TERMS, term_columns
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain, true_inertia

ROBOT = load_robot("a2085_03")
CHAIN, PHI = true_chain(ROBOT), true_inertia(ROBOT).ravel()
JOINTS = len(CHAIN.serials)
RATE_HZ, CUTOFF_HZ = 250.0, 12.0
FRACTION = 2.0 * CUTOFF_HZ / RATE_HZ
SIGMA_NM = 0.02


def swings(
    rng: Generator, duration_s: float = 20.0, phi: Array = PHI, size: float = 1.0
) -> tuple[Array, Array]:
    """All joints on sums of three sines; positions, and the true torques."""
    t = np.arange(int(duration_s * RATE_HZ))[:, None] / RATE_HZ
    q, qd, qdd = np.zeros((3, len(t), JOINTS))
    for amplitude in (0.4 * size, 0.2 * size, 0.1 * size):
        w = 2.0 * np.pi * rng.uniform(0.3, 2.0, JOINTS)
        q += amplitude * np.sin(w * t)
        qd += amplitude * w * np.cos(w * t)
        qdd -= amplitude * w**2 * np.sin(w * t)
    return q, torque_regressor(CHAIN, q, qd, qdd) @ phi


def filtered(q: Array, reading: Array) -> JointMotion:
    times = np.arange(len(q), dtype=np.int64) * 4_000_000
    return filtered_motion(times, q, None, reading, RATE_HZ, CUTOFF_HZ)


def rows(
    motion: JointMotion, departure: Array | None = None, chain: Chain = CHAIN
) -> tuple[JointInformation, ...]:
    rigid = torque_regressor(chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
    terms = term_columns(motion, RATE_HZ, CUTOFF_HZ)
    parts = [rigid, terms] if departure is None else [rigid, terms, departure]
    return compress(np.concatenate(parts, axis=2), motion.tau_nm)


def lagging(torque: Array, lag_s: float) -> Array:
    """The reading r of r + T r' = tau, sample by sample."""
    keep = np.exp(-1.0 / (RATE_HZ * 50 * lag_s))
    found, state = np.empty_like(torque), torque[0]
    fine = np.stack([np.interp(np.arange(0, len(torque), 0.02), range(len(torque)), c) for c in torque.T], 1)
    for k, value in enumerate(fine):
        state = value + (state - value) * keep
        if k % 50 == 0:
            found[k // 50] = state
    return found


def solved(motion: JointMotion) -> InstrumentalFit:
    return solve_instrumental_variables(rows(motion), np.zeros_like(PHI), FRACTION)


def of(fit: InstrumentalFit, term: str) -> tuple[Array, Array]:
    k = [*READING_TERMS].index(term)
    return fit.terms.value[:, k], fit.terms.sigma[:, k]


def test_a_reading_that_is_late_by_the_springs_damping_is_found_to_be(rng: Generator) -> None:
    q, torque = swings(rng)
    reading = lagging(torque, 3e-3) + SIGMA_NM * rng.normal(size=torque.shape)
    found = solved(filtered(q, reading))
    value, sigma = of(found, "lag")
    # The last joint carries next to nothing, so that its reading could be as late as it likes.
    np.testing.assert_array_equal(found.terms.used[:, 0], [True, True, False])
    np.testing.assert_array_less(np.abs(value - 3e-3)[:2], 4.0 * sigma[:2] + 2e-5)
    # What is left is the noise, low-passed; with the lag in it it is several times that.
    left = SIGMA_NM * np.sqrt(FRACTION)
    np.testing.assert_allclose(found.fit.torque_sigma_nm, left, rtol=0.15)


def test_offset_and_friction_are_found_where_they_are_and_nowhere_else(rng: Generator) -> None:
    q, torque = swings(rng)
    rate = np.gradient(q, 1.0 / RATE_HZ, axis=0)
    reading = torque + SIGMA_NM * rng.normal(size=torque.shape)
    reading[:, 0] += 0.3 * rate[:, 0]
    reading[:, 1] += 0.15
    reading[:, 2] += 0.2 * np.tanh(rate[:, 2] / 0.01)
    found = solved(filtered(q, reading))
    expected = np.zeros((JOINTS, len(READING_TERMS)), dtype=bool)
    expected[0, 2] = expected[1, 1] = expected[2, 3] = True
    np.testing.assert_array_equal(found.terms.used, expected)
    for joint, term, true in ((0, "viscous", 0.3), (1, "offset", 0.15), (2, "coulomb", 0.2)):
        value, sigma = of(found, term)
        assert abs(value[joint] - true) < 4.0 * sigma[joint] + 0.01 * true


@pytest.mark.parametrize("tilt", [1e-4, -6e-4, 3e-3])
def test_no_weight_on_a_vertical_axis_stands_for_an_offset(rng: Generator, tilt: float) -> None:
    """An axis that was measured this much askew shows weights, of tonnes if need be, by that angle."""
    # Swings so short that a weight's moment hardly varies with them.
    q, torque = swings(rng, size=0.2)
    torque[:, 0] += 0.04
    motion = filtered(q, torque + SIGMA_NM * rng.normal(size=torque.shape))
    up = np.array([np.sin(tilt), 0.0, np.cos(tilt)]) * np.linalg.norm(CHAIN.gravity)
    assert abs(CHAIN.axis[0] @ up) == pytest.approx(np.linalg.norm(up), rel=1e-4)
    found = solve_instrumental_variables(rows(motion, chain=CHAIN._replace(gravity=up)), PHI, FRACTION)
    value, sigma = of(found, "offset")
    assert found.terms.used[:, READING_TERMS.index("offset")].tolist() == [True, False, False]
    # What a likely weight, 0.3 kg at a module's reach, makes of the angle.
    assert value[0] == pytest.approx(0.04, abs=4.0 * sigma[0] + 9.81 * 0.3 * 0.3 * abs(tilt))
    np.testing.assert_allclose(found.fit.torque_sigma_nm, SIGMA_NM * np.sqrt(FRACTION), rtol=0.15)


@pytest.mark.parametrize("size", [1.0, 0.2, 0.05])
@pytest.mark.parametrize("seed", range(3))
def test_a_heavy_tool_that_the_prior_does_not_know_is_no_offset(seed: int, size: float) -> None:
    rng = default_rng(seed)
    tool = PHI.reshape(JOINTS, -1).copy()
    tool[-1, :4] += 2.0 * np.array([1.0, *(CHAIN.imu_home[-1, :3, 3] + 0.15 * CHAIN.axis[-1])])
    q, torque = swings(rng, phi=tool.ravel(), size=size)
    motion = filtered(q, torque + SIGMA_NM * rng.normal(size=torque.shape))
    found = solve_instrumental_variables(rows(motion), PHI, FRACTION)
    assert not found.terms.used.any()


def test_an_offset_is_as_significant_where_a_tool_is_not_known(rng: Generator) -> None:
    tool = PHI.reshape(JOINTS, -1).copy()
    tool[-1, :4] += 4.0 * np.array([1.0, *(CHAIN.imu_home[-1, :3, 3] + 0.15 * CHAIN.axis[-1])])
    q, torque = swings(rng, 4.0, tool.ravel())
    torque[:, 1] += 0.15
    seen = rows(filtered(q, torque + SIGMA_NM * rng.normal(size=torque.shape)))
    known, unknown = (
        solve_instrumental_variables(seen, phi, FRACTION).terms.gain[1, READING_TERMS.index("offset")]
        for phi in (tool.ravel(), PHI)
    )
    assert unknown > max(SIGNIFICANT_F, 0.7 * known)


def test_a_load_that_held_joints_do_not_tell_from_an_offset_is_none(rng: Generator) -> None:
    """It would be wrong in any other pose, with no uncertainty left."""
    tool = PHI.reshape(JOINTS, -1).copy()
    tool[-1, :4] += 2.0 * np.array([1.0, *(CHAIN.imu_home[-1, :3, 3] + 0.15 * CHAIN.axis[-1])])
    q, _ = swings(rng)
    q[:, 1:] = 0.0
    still = np.zeros_like(q)
    # The first axis is vertical: its motion turns no weight.
    qd = np.gradient(q, 1.0 / RATE_HZ, axis=0)
    torque = torque_regressor(CHAIN, q, qd, still) @ tool.ravel()
    assert np.abs(torque[:, 1]).min() > 2.0
    motion = filtered(q, torque + SIGMA_NM * rng.normal(size=torque.shape))
    found = solve_instrumental_variables(rows(motion), PHI, FRACTION)
    assert not found.terms.used[1:, READING_TERMS.index("offset")].any()
    assert np.isinf(found.terms.spread[1, READING_TERMS.index("offset")])


@pytest.mark.parametrize("seed", range(10))
def test_noise_alone_earns_no_term_a_place(seed: int) -> None:
    rng = default_rng(seed)
    q, torque = swings(rng)
    found = solved(filtered(q, torque + SIGMA_NM * rng.normal(size=torque.shape)))
    assert not found.terms.used.any()
    assert found.terms.gain.max() < SIGNIFICANT_F


def test_a_term_that_is_not_used_is_off_by_no_more_than_is_said(rng: Generator) -> None:
    pulls = []
    for _ in range(20):
        q, torque = swings(rng)
        # Small enough to stay unnoticed.
        offset = 2e-3 * rng.normal(size=JOINTS)
        found = solved(filtered(q, torque + offset + SIGMA_NM * rng.normal(size=torque.shape)))
        k = READING_TERMS.index("offset")
        unused = ~found.terms.used[:, k]
        size = np.sqrt(found.terms.gain[unused, k]) * found.terms.spread[unused, k]
        # What was estimated of it before it was left out is it, to within its spread.
        pulls += ((size - np.abs(offset[unused])) / found.terms.spread[unused, k]).tolist()
    assert len(pulls) > 30
    # In absolute values, whose noise is somewhat smaller than one.
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.3


def test_the_order_of_motions_does_not_matter(rng: Generator) -> None:
    pieces = [rows(filtered(*swings(rng, 6.0))) for _ in range(3)]
    one = solve_instrumental_variables(merge(merge(*pieces[:2]), pieces[2]), np.zeros_like(PHI), FRACTION)
    other = solve_instrumental_variables(
        merge(pieces[2], merge(*pieces[1::-1])), np.zeros_like(PHI), FRACTION
    )
    np.testing.assert_allclose(one.fit.phi, other.fit.phi, rtol=1e-8, atol=1e-10)


def test_noise_in_what_was_seen_does_not_make_inertias_small(rng: Generator) -> None:
    q, torque = swings(rng, 40.0)
    motion = filtered(q, torque + SIGMA_NM * rng.normal(size=torque.shape))
    rigid = torque_regressor(CHAIN, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
    # Accelerations that are seen with as much noise as they have signal.
    noisy = motion.qdd_rad_s2 + motion.qdd_rad_s2.std(axis=0) * rng.normal(size=q[: len(rigid)].shape)
    seen = torque_regressor(CHAIN, motion.q_rad, motion.qd_rad_s, noisy)
    found = solve_instrumental_variables(rows(motion, seen - rigid), np.zeros_like(PHI), FRACTION)
    plain = compress(seen, motion.tau_nm)
    shrunk = np.linalg.lstsq(
        np.vstack([p.r for p in plain]), np.concatenate([p.z for p in plain]), rcond=1e-6
    )[0]
    tried = rigid @ PHI
    # Least squares on the noisy motion loses a good part of the torque of acceleration, instruments do not.
    assert np.linalg.norm(rigid @ found.fit.phi - tried) < 0.3 * np.linalg.norm(rigid @ shrunk - tried)


def test_what_a_rigid_robot_does_not_show_is_not_taken_from_noise(
    rng: Generator,
) -> None:
    q, torque = swings(rng)
    motion = filtered(q, torque + SIGMA_NM * rng.normal(size=torque.shape))
    rigid = torque_regressor(CHAIN, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
    departure = 0.02 * rng.normal(size=rigid.shape) * (np.abs(rigid).sum(axis=0) > 0.0)
    found = solve_instrumental_variables(rows(motion, departure), np.zeros_like(PHI), FRACTION)
    assert found.fit.rank == solved(motion).fit.rank


def test_rows_of_other_columns_are_refused() -> None:
    q, torque = swings(default_rng(1), 4.0)
    motion = filtered(q, torque)
    plain = compress(torque_regressor(CHAIN, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2), motion.tau_nm)
    with pytest.raises(ValueError, match=r"\[30\] columns"):
        solve_instrumental_variables(plain, np.zeros_like(PHI), FRACTION)
