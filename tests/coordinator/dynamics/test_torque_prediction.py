"""The relative torque error and the whole way from noisy samples to a held-out prediction."""

import numpy as np
import pytest
from numpy.random import default_rng

from coordinator.dynamics.torque_prediction import check_held_out, error_in_words, torque_error
from coordinator.parameter_fit.least_squares import solve_information
from module_agent.model.chain import Chain
from module_agent.model.errors import DataError
from module_agent.model.information import gather
from module_agent.model.regressor import inverse_dynamics
from module_agent.signals.filtering import JointMotion, filtered_motion


def test_the_error_is_the_ratio_of_norms() -> None:
    tau = np.array([[3.0, 1.0], [4.0, 0.0]])
    found = torque_error(tau, tau + np.array([[0.0, 0.5], [0.5, 0.0]]), [3.0, 1.0])
    assert found.per_joint == pytest.approx([0.1, 0.5])
    assert found.overall == pytest.approx(np.sqrt(0.5 / 26.0))
    assert found.mean_per_joint == pytest.approx([0.2, 1.0])
    assert found.mean_overall == pytest.approx(np.sqrt(2.0 / 26.0))
    assert found.samples.tolist() == [2, 2]


def test_a_mask_leaves_samples_out_of_error_and_size_alike() -> None:
    tau = np.array([[3.0, 1.0], [4.0, 2.0]])
    found = torque_error(tau, tau + np.array([[9.0, 0.1], [0.4, 0.1]]), [0.0, 0.0], mask=[[False], [True]])
    assert found.per_joint == pytest.approx([0.1, 0.05])
    assert found.samples.tolist() == [1, 1]


def test_a_joint_without_torque_has_no_relative_error() -> None:
    found = torque_error(np.array([[1.0, 0.0]]), np.array([[1.1, 0.1]]), [0.0, 0.0])
    assert found.per_joint[0] == pytest.approx(0.1)
    assert np.isnan(found.per_joint[1])


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        torque_error(np.ones((2, 2)), np.ones((2, 1)), np.ones(2))
    with pytest.raises(DataError, match="lets none through"):
        torque_error(np.ones((2, 2)), np.ones((2, 2)), np.ones(2), mask=np.zeros((2, 2)))
    with pytest.raises(DataError, match="not finite"):
        torque_error(np.full((2, 2), np.nan), np.ones((2, 2)), np.ones(2))


def arm() -> Chain:
    return Chain(
        serials=("A", "B"),
        parent=(-1, 0),
        reversed=(False, False),
        axis=np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
        point=np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.05]]),
        imu_home=np.tile(np.eye(4), (2, 1, 1)),
        gravity=np.array([0.0, 0.0, 9.81]),
    )


def test_parameters_from_noisy_samples_predict_another_motion() -> None:
    # 14-bit encoder, a torque noise of 20 mNm, 250 Hz; two bodies of half a kilogram.
    rng = default_rng(7)
    phi = np.zeros((2, 10))
    phi[0] = [0.4, 0.02, 0.0, 0.02, 2e-3, 0, 0, 3e-3, 0, 3e-3]
    phi[1] = [0.6, 0.18, 0.01, 0.03, 4e-3, 0, 0, 8e-2, 0, 8e-2]
    chain = arm()
    t = np.arange(2500) / 250.0
    t_ns = np.round(t * 1e9).astype(np.int64)

    def record(frequencies: tuple[float, float], amplitude: float) -> JointMotion:
        w = 2 * np.pi * np.array(frequencies)
        q = amplitude * np.sin(t[:, None] * w)
        qd, qdd = amplitude * w * np.cos(t[:, None] * w), -(w**2) * q
        tau = inverse_dynamics(chain, phi, q, qd, qdd) + 0.02 * rng.normal(size=q.shape)
        step = 2 * np.pi / 2**14
        return filtered_motion(t_ns, step * np.round(q / step), qd, tau, 250.0, 20.0)

    fitted, held_out = record((1.1, 1.7), 0.4), record((0.7, 1.9), 0.5)
    fit = solve_information(gather(chain, *fitted[1:]), independent_fraction=2 * 20.0 / 250.0)
    found = check_held_out(chain, fit.phi, held_out, fitted.tau_nm.mean(axis=0))
    # The low-pass leaves 8 mNm of noise (20 Hz of 125 Hz) in the held-out torque itself, of about 0.5 and 1.3
    # Nm rms.
    assert found.error.overall < 0.015
    assert found.error.per_joint.max() < 0.03
    assert found.error.mean_overall > 10 * found.error.overall
    assert found.tau_predicted_nm.shape == held_out.tau_nm.shape


def test_a_percentage_is_given_only_of_a_torque_that_is_no_noise() -> None:
    assert error_in_words(0.05, 2.0) == "0.050 Nm of 2.000 Nm (2.5 %)"
    assert error_in_words(0.051, 0.0165) == "0.051 Nm of 0.017 Nm"
