"""A blow is felt within two samples, by the joints below it; what lasts, and noise, is none."""

import numpy as np
import pytest
from scipy.signal import lfilter

from coordinator.monitoring.contact import ContactDetector, ContactModel, FastPart, contact_model
from coordinator.monitoring.momentum_observer import GAIN_HZ, MomentumObserver
from coordinator.monitoring.segments import noise_level
from module_agent.model.regressor import inverse_dynamics
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain, true_inertia

RATE_HZ = 250.0
ROBOT = load_robot("a2085_03")
CHAIN, PHI = true_chain(ROBOT), true_inertia(ROBOT).ravel()


def swing(seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t = np.arange(round(seconds * RATE_HZ))[:, None] / RATE_HZ
    w = 2.0 * np.pi * np.array([0.4, 0.7, 1.1])
    return 0.6 * np.sin(w * t), 0.6 * w * np.cos(w * t), -0.6 * w**2 * np.sin(w * t)


def test_the_momentum_shows_a_push_through_the_low_pass_that_it_is_said_to_be() -> None:
    q, qd, qdd = swing(4.0)
    push = np.zeros_like(q)
    push[400:450] = [0.5, -1.0, 0.3]
    torque = inverse_dynamics(CHAIN, PHI, q, qd, qdd) - push
    found = MomentumObserver(CHAIN, PHI).advance(q, qd, torque)
    share = GAIN_HZ / RATE_HZ
    mean = 0.5 * (push + np.vstack([push[:1], push[:-1]]))
    expected = lfilter([share], [1.0, share - 1.0], mean, axis=0)
    # The trapezoid of the forces at 250 Hz: 1e-3 of torques of some 4 Nm.
    np.testing.assert_allclose(found, expected, atol=5e-3)


def test_it_does_not_matter_how_samples_come_in_blocks() -> None:
    q, qd, qdd = swing(1.0)
    torque = inverse_dynamics(CHAIN, PHI, q, qd, qdd) + 0.2
    whole = MomentumObserver(CHAIN, PHI).advance(q, qd, torque)
    piecemeal, fast = MomentumObserver(CHAIN, PHI), FastPart()
    parts = [slice(k, k + 7) for k in range(0, len(q), 7)]
    found = [piecemeal.advance(q[p], qd[p], torque[p]) for p in parts]
    np.testing.assert_allclose(np.vstack(found), whole, atol=1e-12)
    np.testing.assert_allclose(
        np.vstack([fast.advance(one) for one in found]), FastPart().advance(whole), atol=1e-12
    )


def test_what_lasts_is_no_blow() -> None:
    step = np.ones((2500, 1))
    step[:500] = 0.0
    fast = FastPart().advance(step)
    assert fast[500, 0] > 0.99
    # After nine seconds of a time constant of 0.8 s.
    assert abs(fast[-1, 0]) < 1e-4


def test_noise_crosses_its_level_as_often_as_rice_says() -> None:
    rng = np.random.default_rng(3)
    # A second-order low-pass of white noise has a finite rate of crossings.
    noise = lfilter([1.0], np.convolve([1.0, -0.8], [1.0, -0.8]), rng.normal(size=(400_000, 1)), axis=0)
    noise /= noise.std()
    model = contact_model([noise])._replace(largest_nm=np.zeros(1))
    asked = 3600.0 * 0.5
    level = model.level_nm(asked)[0]
    beyond = np.abs(noise[:, 0]) > level
    rate = np.count_nonzero(~beyond[:-1] & beyond[1:]) / (len(noise) / RATE_HZ)
    # 800 crossings in 1600 s: within 15 %, as samples miss crossings between them.
    assert rate == pytest.approx(0.5, rel=0.15)


def test_where_a_session_begins_is_no_contact_in_what_is_normal() -> None:
    """The model's error of the pose in which it begins is a step to a low-pass that begins with it."""
    noise = np.random.default_rng(4).normal(scale=0.01, size=(2000, 1))
    session = noise + 0.3 * np.exp(-np.arange(2000) / (0.1 * RATE_HZ))[:, None]
    one, two = contact_model([session]), contact_model([session, session])
    assert one.largest_nm == pytest.approx(two.largest_nm)
    assert one.largest_nm[0] < 0.06
    assert two.sigma_nm == pytest.approx(one.sigma_nm)
    assert two.crossings_hz == pytest.approx(one.crossings_hz)


def test_a_blow_is_said_when_it_begins_and_when_it_is_over() -> None:
    detector = ContactDetector(np.array([0.1, 0.1]))
    t_ns = np.arange(500) * 4_000_000
    fast = np.zeros((500, 2))
    fast[100:120] = [0.05, -0.4]
    began, ended = detector.advance(t_ns, fast)
    # The second sample in a row.
    assert began.start_ns == t_ns[101]
    assert began.end_ns is None
    assert began.joints == (1,)
    assert ended.end_ns == t_ns[119]
    assert ended.peak_nm[1] == -0.4
    assert detector.now is None


def test_one_sample_alone_is_none() -> None:
    fast = np.zeros((100, 1))
    fast[50] = 5.0
    assert not ContactDetector(np.array([0.1])).advance(np.arange(100) * 4_000_000, fast)


def test_levels_are_above_all_that_the_known_run_has() -> None:
    model = ContactModel(np.array([0.01]), np.array([0.2]), np.array([5.0]))
    assert model.level_nm(0.1)[0] > 0.2


def test_coloured_noise_counts_for_as_many_samples_as_its_autocorrelation_says() -> None:
    rng = np.random.default_rng(5)
    for memory in (0.0, 0.5, 0.9):
        noise = lfilter([1.0], [1.0, -memory], rng.normal(size=(60_000, 2)), axis=0)
        sigma, counted = noise_level(np.array_split(noise, 100))
        # Of a first-order process: (1 + a) / (1 - a); the sum is cut off in noise of some per cent.
        np.testing.assert_allclose(counted, (1.0 + memory) / (1.0 - memory), rtol=0.2)
        np.testing.assert_allclose(sigma, 1.0 / np.sqrt(1.0 - memory**2), rtol=0.03)
