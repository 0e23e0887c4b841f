"""Which motions a robot refuses to follow, and how its tracking error is measured."""

import numpy as np
import pytest

from coordinator.torque_control.feed_forward import Reference
from coordinator.torque_control.gravity_model import GravityModel
from coordinator.torque_control.tracking import MotionRefused, check_motion_limits, mode_tracking
from module_agent.control.gains import catalogue_limits
from module_agent.model.catalogue import CATALOGUE
from module_agent.model.chain import Chain
from module_agent.model.errors import RobotError
from module_agent.wire.feedback_rows import ROW

X5_4 = CATALOGUE["X5-4"]
G_M_S2, REACH_M = 9.81, 0.3


def pendulum(mass_kg: float) -> GravityModel:
    """A mass on the x axis that turns about y."""
    chain = Chain(
        serials=("J",),
        parent=(-1,),
        reversed=(False,),
        axis=np.array([[0.0, 1.0, 0.0]]),
        point=np.zeros((1, 3)),
        imu_home=np.eye(4)[None],
        gravity=np.array([0.0, 0.0, G_M_S2]),
    )
    inertia = mass_kg * REACH_M**2
    phi = np.array([mass_kg, mass_kg * REACH_M, 0.0, 0.0, 0.0, 0.0, 0.0, inertia, 0.0, inertia])
    return GravityModel("pendulum", ("X5-4",), chain, phi)


def swing(amplitude_rad: float, speed_rad_s: float) -> Reference:
    w, t_s = speed_rad_s / amplitude_rad, np.linspace(0.0, 1.0, 1001)
    q = amplitude_rad * np.sin(w * t_s)[:, None]
    return Reference(t_s, q, amplitude_rad * w * np.cos(w * t_s)[:, None], -(w**2) * q)


@pytest.mark.parametrize(
    ("mass_kg", "amplitude", "speed", "text"),
    [
        (0.1, 1.2, 2.0, r"joint J \(X5-4\): position 1.20 rad at .* its limit is 1.00 rad"),
        (0.1, 0.5, 20.0, r"joint J \(X5-4\): speed 20.00 rad/s at 0.00 s of the motion, its limit is"),
        (5.0, 0.5, 1.0, r"joint J \(X5-4\): calculated torque 14\.[0-9]* Nm .* its limit is"),
    ],
)
def test_a_motion_beyond_a_limit_is_refused_with_joint_time_and_limit(
    mass_kg: float, amplitude: float, speed: float, text: str
) -> None:
    limits = catalogue_limits(X5_4).model_copy(update={"min_position_rad": -1.0, "max_position_rad": 1.0})
    with pytest.raises(MotionRefused, match=text):
        check_motion_limits(pendulum(mass_kg), swing(amplitude, speed), [limits])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_both_ends_of_a_range_hold(sign: float) -> None:
    limits = catalogue_limits(X5_4).model_copy(
        update={"min_position_rad": -0.1 if sign > 0 else None, "max_position_rad": 0.1 if sign < 0 else None}
    )
    still = np.zeros((2, 1))
    at = Reference(np.array([0.0, 1.0]), np.full((2, 1), -0.2 * sign), still, still)
    at_s = "" if sign < 0 else "-"
    with pytest.raises(MotionRefused, match=rf"position {at_s}0\.20 rad .* its limit is {at_s}0\.10 rad"):
        check_motion_limits(pendulum(0.1), at, [limits])
    inside = at._replace(q_rad=-at.q_rad)
    check_motion_limits(pendulum(0.1), inside, [limits])


def test_the_error_is_that_against_the_modules_own_set_points() -> None:
    rows = np.zeros(4, dtype=ROW)
    rows["position_rad"], rows["position_command_rad"] = (0.1, 0.3, 0.0, 9.0), (0.0, 0.0, 0.2, np.nan)
    measured = mode_tracking(2, {"A": rows, "B": rows[:1]})
    one, other = measured.joints
    assert (one.serial, other.serial) == ("A", "B")
    assert one.rms_rad == pytest.approx(np.sqrt((0.01 + 0.09 + 0.04) / 3.0))
    assert one.worst_rad == pytest.approx(0.3)
    assert one.bias_rad == pytest.approx(0.2 / 3.0)
    assert measured.rms_rad == pytest.approx(np.sqrt(0.5 * (one.rms_rad**2 + 0.01)))
    assert measured.worst_rad == pytest.approx(0.3)


def test_a_module_without_a_set_point_is_named() -> None:
    rows = np.zeros(2, dtype=ROW)
    rows["position_command_rad"] = np.nan
    with pytest.raises(RobotError, match="module A sent no feedback with a set-point"):
        mode_tracking(1, {"A": rows})
