"""Encoders that read too much or too little: their scales are told from the motion that gyros see."""

from typing import Any

import numpy as np
import pytest

from coordinator.batch_estimation.encoder_scale import ENCODER_SCALE_SIGMA, with_encoder_scales
from coordinator.batch_estimation.estimator import refine_chain
from coordinator.batch_estimation.imu_prediction import imu_readings
from coordinator.batch_estimation.link_compliance import rigid
from coordinator.batch_estimation.sensor_data import SensorData
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import CALIBRATED
from tests.random_chains import displaced

GYRO_NOISE, ACCEL_NOISE = 2e-4, 3e-3


def _swing(joints: int, samples: int = 300) -> tuple[Array, Array, Array]:
    """All joints at once at 1 to 2 Hz about half a radian: positions, velocities, accelerations, (m, n)."""
    t, k = np.linspace(0.0, 4.0, samples)[:, None], np.arange(joints)
    rate, phase = 7.0 + 1.3 * k, 0.7 * k
    q, qd = 0.5 + 0.2 * np.sin(rate * t + phase), 0.2 * rate * np.cos(rate * t + phase)
    return q, qd, -0.2 * rate**2 * np.sin(rate * t + phase)


def _chain(robots: Any, seed: int) -> Chain:
    chain, _ = robots.random(seed, joints=4, serial=True)
    return chain  # type: ignore[no-any-return]


def _moved_more(joints: tuple[Array, Array, Array], module: int, scale: float) -> tuple[Array, Array, Array]:
    """The motion of a joint that moves 1 + scale times as much about its mean."""
    factor = np.ones(joints[0].shape[1])
    factor[module] += scale
    mean = joints[0].mean(axis=0)
    return mean + factor * (joints[0] - mean), factor * joints[1], factor * joints[2]


@pytest.mark.parametrize("module", [0, 2])
def test_slopes_are_those_of_a_motion_that_is_larger(robots: Any, module: int) -> None:
    chain, joints = _chain(robots, 3), _swing(4)
    flex = with_encoder_scales(rigid(len(joints[0])), chain, joints, [module])
    assert flex.links == (module,)
    assert flex.sigmas.tolist() == [ENCODER_SCALE_SIGMA]
    assert flex.taken.tolist() == [0.0]
    # Central differences over a step of a thousandth leave a millionth of the second derivative's share.
    more, less = (imu_readings(chain, *_moved_more(joints, module, scale)) for scale in (1e-3, -1e-3))
    slopes = displaced(chain, joints, flex.carried, np.ones(1))
    for part, (up, down) in zip(np.split(slopes, 2, axis=1), zip(more, less, strict=True), strict=True):
        slope = (up - down).transpose(1, 2, 0) / 2e-3
        np.testing.assert_allclose(part, slope, atol=2e-3 * float(np.abs(slope).max()))
    # IMUs that the joint does not carry read the same.
    carried = [module in chain.ancestors(chain.carrier(k)) for k in range(4)]
    assert slopes.any(axis=(1, 2)).tolist() == carried


def test_without_modules_nothing_is_added(robots: Any) -> None:
    joints = _swing(4)
    flex = rigid(len(joints[0]))
    assert with_encoder_scales(flex, _chain(robots, 3), joints, []) is flex


@pytest.mark.parametrize("seed", range(3))
def test_the_scale_of_an_encoder_is_recovered_and_lengths_with_it(robots: Any, seed: int) -> None:
    chain, joints = _chain(robots, 40 + seed), _swing(4)
    true = imu_readings(chain, *_moved_more(joints, 1, 0.01))
    rng = np.random.default_rng(seed)
    gyro, accel = (
        signal + rng.normal(0.0, size, signal.shape)
        for signal, size in zip(true, (GYRO_NOISE, ACCEL_NOISE), strict=True)
    )
    data = SensorData(*joints, gyro, accel, np.zeros((*gyro.shape[:2], 6)))
    flex = with_encoder_scales(rigid(len(joints[0])), chain, joints, range(4))
    free, trusting = (refine_chain(chain, data, CALIBRATED, each) for each in (flex, None))
    scale, sigma = free.compliance, free.compliance_sigma
    assert abs(scale[1] - 0.01) < 4.0 * sigma[1] < 0.002
    assert np.all(np.abs(scale[[0, 2, 3]]) < 4.0 * sigma[[0, 2, 3]])
    # 1 % of the links' lengths follows an encoder that is trusted.
    apart = [
        np.abs(fit.chain.imu_home[:, :3, 3] - chain.imu_home[:, :3, 3]).max() for fit in (free, trusting)
    ]
    assert apart[0] < 0.5 * apart[1]
