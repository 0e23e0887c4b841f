"""The thesis' estimator of a load recovers a rigid frictionless arm, and errs where its model is wrong."""

import numpy as np
import pytest

from module_agent.estimate.gaussian_filter import kernel
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.read_only import frozen
from module_agent.model.regressor import inverse_dynamics, torque_regressor
from sim.thesis.dynamics.load_identification import (
    IZZ,
    MCX,
    MCY,
    JointSamples,
    identify_load,
    identify_load_by_six_rows,
    least_mass_kg,
    wrench_rows,
)

RATE_HZ = 250.0
UPRIGHT = (0.0, 9.81, 0.0)
# m, m c, I of a body that is anywhere in space.
PHI = np.array([0.67, 0.225, -0.02, 0.04, 0.003, 0.001, -0.015, 0.098, 0.0002, 0.095])


def chain(force_m_s2: tuple[float, float, float]) -> Chain:
    return Chain(
        serials=("X-1",),
        parent=(BASE,),
        reversed=(False,),
        axis=frozen([[0.0, 0.0, 1.0]]),
        point=frozen([[0.0, 0.0, 0.0]]),
        imu_home=frozen([np.eye(4)]),
        gravity=frozen(force_m_s2),
    )


def motion(amplitude_rad: float, frequency_hz: float = 1.0, duration_s: float = 4.0) -> tuple[Array, ...]:
    """Times, positions, velocities and accelerations of a sine."""
    t = np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
    w = 2.0 * np.pi * frequency_hz
    q = amplitude_rad * np.sin(w * t)
    return t, q, amplitude_rad * w * np.cos(w * t), -(w**2) * q


def samples(amplitude_rad: float, frequency_hz: float = 1.0) -> JointSamples:
    """What the rigid, frictionless arm measures without noise."""
    t, q, qd, qdd = motion(amplitude_rad, frequency_hz)
    signals = (signal[:, None] for signal in (q, qd, qdd))
    return JointSamples(t, q, qd, inverse_dynamics(chain(UPRIGHT), PHI, *signals)[:, 0])


def test_the_moment_about_the_axis_is_that_of_the_robots_regressor() -> None:
    force = (1.0, 9.0, 3.0)
    _, q, qd, qdd = motion(0.7)
    rows = wrench_rows(q, qd, qdd, force, "with the link")
    own = torque_regressor(chain(force), *(signal[:, None] for signal in (q, qd, qdd)))
    np.testing.assert_allclose(rows[:, 5], own[:, 0], atol=1e-12)


def test_a_wrench_is_that_of_point_masses_in_the_turning_frame() -> None:
    q, omega, alpha = 0.4, 1.7, -5.0
    force = np.array([1.0, 9.0, 3.0])
    points = np.array([[0.3, 0.1, -0.2], [-0.1, 0.2, 0.05], [0.2, -0.3, 0.1]])
    masses = np.array([0.2, 0.5, 0.1])
    tensor = sum(m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, points, strict=True))
    phi = np.concatenate([[masses.sum()], masses @ points, tensor[np.triu_indices(3)]])
    turn = np.array([[np.cos(q), np.sin(q), 0.0], [-np.sin(q), np.cos(q), 0.0], [0.0, 0.0, 1.0]])
    axis = np.array([0.0, 0.0, 1.0])
    spins = np.cross(alpha * axis, points) + np.cross(omega * axis, np.cross(omega * axis, points))
    forces = masses[:, None] * (turn @ force + spins)
    wrench = np.concatenate([forces.sum(axis=0), np.cross(points, forces).sum(axis=0)])
    rows = wrench_rows([q], [omega], [alpha], force, "with the link")[0]
    np.testing.assert_allclose(rows @ phi, wrench, atol=1e-12)


def test_a_rigid_frictionless_arm_is_recovered_exactly() -> None:
    _, q, qd, qdd = motion(0.7)
    rows = wrench_rows(q, qd, qdd, UPRIGHT, "with the link")[:, 5]
    torque = inverse_dynamics(chain(UPRIGHT), PHI, *(signal[:, None] for signal in (q, qd, qdd)))[:, 0]
    phi = np.linalg.pinv(rows) @ torque
    np.testing.assert_allclose(phi[[MCX, MCY, IZZ]], PHI[[MCX, MCY, IZZ]], atol=1e-10)
    np.testing.assert_allclose(np.delete(phi, [MCX, MCY, IZZ]), 0.0, atol=1e-10)


def test_the_estimator_recovers_it_but_for_the_differentiation() -> None:
    # A central difference at 1 Hz and 250 Hz is (2 pi 1 / 250)^2 / 6 = 1.1e-4 short, those at both ends are
    # late by 2 ms; gravity's sine is nearly collinear, and makes up for a share of Izz w^2 / g of it.
    fit = identify_load(samples(0.7), UPRIGHT, "with the link", filtered=False)
    assert fit.phi[MCX] == pytest.approx(PHI[MCX], rel=1e-3)
    assert fit.phi[IZZ] == pytest.approx(PHI[IZZ], rel=2e-3)
    assert fit.phi[MCY] == pytest.approx(PHI[MCY], abs=2e-3 * PHI[IZZ] * (2.0 * np.pi) ** 2 / 9.81)


def test_the_filter_of_the_acceleration_alone_makes_inertias_large() -> None:
    taps = kernel()
    delay_s = (np.arange(taps.size) - taps.size // 2) / RATE_HZ
    passed = float(taps @ np.cos(2.0 * np.pi * 2.0 * delay_s))
    at_2_hz = samples(0.01, frequency_hz=2.0)
    raw, smooth = (identify_load(at_2_hz, UPRIGHT, filtered=each).phi[IZZ] for each in (False, True))
    assert smooth / raw == pytest.approx(1.0 / passed, abs=1e-4)
    assert passed == pytest.approx(0.9924, abs=1e-4)


def test_gravity_at_rest_in_the_frame_leaves_an_error_that_grows_with_the_angle() -> None:
    small, large = (identify_load(samples(angle), UPRIGHT).squared_error_nm2 for angle in (0.1, 0.7))
    turned = identify_load(samples(0.7), UPRIGHT, "with the link").squared_error_nm2
    # mcx g (cos q - mean) grows with the square of the angle, its square with the fourth power.
    assert large > 100.0 * small
    assert turned < 0.01 * large


def test_six_rows_make_a_mass_of_nothing_and_the_first_moment_too_small() -> None:
    fast = samples(0.4, frequency_hz=1.0)
    fit = identify_load_by_six_rows(fast, UPRIGHT)
    assert abs(fit.phi[0]) < 0.01
    # alpha of 0.4 (2 pi)^2 / sqrt 2 rms is larger than g: more is lost than is left.
    assert fit.phi[MCX] < 0.5 * PHI[MCX]


def test_no_body_weighs_less_than_its_moments_say() -> None:
    def body(masses: Array, distances_m: Array) -> Array:
        phi = np.zeros(10)
        phi[0], phi[MCX], phi[IZZ] = masses.sum(), masses @ distances_m, masses @ distances_m**2
        return phi

    assert least_mass_kg(body(np.array([0.4]), np.array([0.3]))) == pytest.approx(0.4)
    rng = np.random.default_rng(0)
    for _ in range(20):
        phi = body(rng.uniform(0.1, 1.0, 5), rng.uniform(0.0, 0.5, 5))
        assert least_mass_kg(phi) < phi[0]


def test_a_value_that_is_not_finite_is_refused() -> None:
    whole = samples(0.2)
    torque = whole.tau_nm.copy()
    torque[17] = np.nan
    broken = whole._replace(tau_nm=torque)
    with pytest.raises(DataError, match="not finite"):
        identify_load(broken, UPRIGHT)
    with pytest.raises(DataError, match="not finite"):
        identify_load_by_six_rows(broken, UPRIGHT)
