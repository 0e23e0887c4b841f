import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from module_agent.model.catalogue import module_type
from sim.actuator.actuator import Actuators
from sim.actuator.spring import Springs, build_springs
from sim.imperfections.noise_profile import NOISE_PROFILES

IDEAL = NOISE_PROFILES["ideal"]
TYPES = [module_type(name) for name in ("X5-1", "X5-4", "X5-9")]


def _springs(share: float, gap_rad: float = 0.0, factor: float = 1.0) -> Springs:
    profile = IDEAL.model_copy(update={"spring_stiffening": share, "backlash_rad": gap_rad})
    return build_springs(TYPES, profile, np.full(3, factor))


def _slope(springs: Springs, y: np.ndarray) -> np.ndarray:
    return (springs.torque(y + 1e-7) - springs.torque(y - 1e-7)) / 2e-7


def test_a_stiffening_spring_has_the_published_stiffness_near_zero_and_at_full_load() -> None:
    springs = _springs(1.0)
    full = np.array([t.max_effort_nm for t in TYPES])
    near, loaded = _slope(springs, np.zeros(3)), _slope(springs, springs.stretch(full))
    # Published: 30-70 Nm/rad near zero and 300-1000 at full load, over the range of types.
    np.testing.assert_allclose([near[0], near[2]], [30.0, 70.0], rtol=1e-6)
    np.testing.assert_allclose([loaded[0], loaded[2]], [300.0, 1000.0], rtol=1e-6)
    assert near[0] < near[1] < near[2]
    assert loaded[0] < loaded[1] < loaded[2]


def test_a_linear_spring_has_the_catalogues_stiffness_whatever_it_carries() -> None:
    springs = _springs(0.0)
    y = np.array([0.01, 0.05, -0.08])
    np.testing.assert_allclose(springs.torque(y) / y, [t.spring_nm_rad for t in TYPES], rtol=1e-12)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(share=st.floats(0.0, 1.0), gap=st.floats(0.0, 0.05), torque=st.floats(-30.0, 30.0))
def test_a_spring_carries_a_torque_at_the_stretch_that_it_says(
    share: float, gap: float, torque: float
) -> None:
    springs = _springs(share, gap)
    found = springs.torque(springs.deflection(springs.stretch(np.full(3, torque))))
    np.testing.assert_allclose(found, torque, atol=1e-9)


def test_a_springs_energy_is_the_work_done_on_it() -> None:
    springs = _springs(0.6, factor=1.1)
    for i, end in enumerate((0.05, -0.08, 0.06)):
        work = quad(lambda y, i=i: float(springs.torque(np.full(3, y))[i]), 0.0, end)[0]
        assert springs.energy_j(np.full(3, end))[i] == pytest.approx(work, rel=1e-9)


def test_within_the_gap_nothing_is_transmitted_and_beyond_it_the_sensor_sees_the_spring_alone() -> None:
    gap = 0.02
    profile = IDEAL.model_copy(update={"backlash_rad": gap})
    actuator = Actuators([TYPES[1]], 1e-3, profile)
    heavy, still = np.array([[1e6]]), np.zeros(1)
    torques, deflections, stretches = [], [], []
    # Slowly, a hundredth of the way to full load, against an output that does not move.
    for pwm in np.linspace(0.0, 0.12, 1500):
        stretches.append(float(actuator.state.motor_rad[0]))
        torque, _ = actuator.step(np.array([pwm]), still, still, heavy, still)
        torques.append(float(torque[0]))
        deflections.append(float(actuator.state.deflection_rad[0]))
    inside = np.abs(stretches) <= gap / 2
    assert 50 < inside.sum() < 1450
    assert not np.array(torques)[inside].any()
    assert not np.array(deflections)[inside].any()
    beyond = np.array(stretches)[~inside]
    np.testing.assert_allclose(np.array(deflections)[~inside], -(beyond - gap / 2), atol=1e-12)
    assert actuator.state.elastic_nm[0] == pytest.approx(-100.0 * actuator.state.deflection_rad[0], rel=1e-12)
    assert torques[-1] > 0.1
