"""Full PWM against a configured limit, judged by where the joints truly are."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.kinematics.chain_estimate import link_lengths
from coordinator.viewer.feed import ViewerFeed
from module_agent.control.controller import Command
from module_agent.control.gains import default_gains
from module_agent.control.safety import Safety
from module_agent.hardware.loop_inside import LoopInside
from module_agent.model.catalogue import module_type
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.virtual_time.robot import VirtualRobot
from sim.virtual_time.run import QUICK_PLAN, VirtualConfig, run_virtual
from sim.world.world import World

NAN = math.nan
RANGE = (-0.5, 0.5)
# Each with the direction in which it is hardest: base joints turn heavy arms, shoulders fall with gravity.
HEAVY = [("a2085_04", 0, 1.0), ("a2085_04", 1, -1.0), ("arm7", 1, 1.0), ("a2085_04", 3, 1.0)]


class Pushed:
    """A robot with one joint by DirectPWM under limits; the others hold."""

    def __init__(self, robot: str, joint: int, **limits: Any) -> None:
        self.world = World(load_robot(robot), seed=1)
        serial = self.world.modules[joint].serial
        self.joint, self.loops = joint, LoopInside(self.world, {serial: Safety(**limits)})
        for k, module in enumerate(self.loops.information):
            gains = default_gains(module_type(module.module_type), 1 if k == joint else 4)
            self.loops.set_gains(k, gains)
        self.gear = module_type(self.world.modules[joint].module_type).gear_ratio
        self.home: list[float] = []
        self.fault = ""

    def push(self, pwm: float, seconds: float) -> np.ndarray:
        """Return true position and speed, current, PWM and the motor's speed at the output (m, 5)."""
        rows = []
        for _ in range(round(seconds * 1000)):
            samples = self.loops.receive()
            self.home = self.home or [sample.sensors.position_rad for sample in samples]
            commands = [Command(home, NAN, NAN) for home in self.home]
            commands[self.joint] = Command(NAN, NAN, pwm)
            out = self.loops.send(commands)[self.joint]
            self.fault = self.fault or samples[self.joint].fault
            plant = self.world.plant
            rows.append(
                (
                    plant.q_rad[self.joint],
                    plant.qd_rad_s[self.joint],
                    samples[self.joint].sensors.motor_current_a,
                    out,
                    samples[self.joint].sensors.motor_velocity_rad_s / self.gear,
                )
            )
        return np.array(rows)


@pytest.mark.parametrize(("robot", "joint", "sign"), HEAVY)
def test_full_pwm_against_a_limit_stops_before_it(robot: str, joint: int, sign: float) -> None:
    pushed = Pushed(robot, joint, position_rad=RANGE)
    q = pushed.push(sign, 2.5)[:, 0]
    assert np.abs(q).max() < 0.5
    # It gets there all but the margin and what friction leaves of it.
    assert sign * q[-1] > 0.45
    # The holder swings it to and fro as hard as it can.
    for turn in range(4):
        assert np.abs(pushed.push(sign * (-1.0) ** turn, 0.5)[:, 0]).max() < 0.5


def test_without_a_limit_it_goes_on() -> None:
    assert np.abs(Pushed("a2085_04", 0, position_rad=(-0.5, 9.0)).push(1.0, 1.0)[:, 0]).max() > 1.0


def test_a_motor_that_is_off_at_its_limit_stops_before_it() -> None:
    pushed = Pushed("a2085_04", 0, position_rad=RANGE, at_limit="motor_off")
    rows = pushed.push(1.0, 1.5)
    assert "motor off" in pushed.fault
    assert 0.45 < np.abs(rows[:, 0]).max() < 0.5
    assert np.all(rows[-500:, 3] == 0.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_speed_limit_is_that_of_the_motor_with_and_against_gravity(sign: float) -> None:
    """The arm swings about the motor on its spring, and goes on at its speed."""
    rows = Pushed("a2085_04", 1, velocity_rad_s=0.5).push(sign, 1.0)
    assert 0.35 < np.abs(rows[:, 4]).max() < 0.53
    assert np.abs(np.mean(rows[500:, 1])) < 0.53


def test_a_current_limit_holds_within_the_scatter_of_windings() -> None:
    amps = np.abs(Pushed("a2085_04", 0, current_a=0.4).push(1.0, 1.0)[:, 2])
    assert 0.36 < amps.max() < 0.44


def test_a_joint_that_stood_outside_its_range_goes_back_to_the_end_of_it(tmp_path: Path) -> None:
    """As one that has fallen before the session: the range does not allow to lead it out again."""
    robot = load_robot("thesis_171_horizontal")
    base, tip = robot.modules
    robot = robot.model_copy(update={"modules": (base, tip.model_copy(update={"start_rad": 1.0}))})
    ended: list[VirtualRobot] = []
    config = VirtualConfig(
        robot,
        tmp_path / "run",
        network="none",
        noise="x5",
        plan=QUICK_PLAN,
        safety={tip.serial: Safety(position_rad=(-0.9, 0.9))},
    )
    run_virtual(config, between=ended.append)
    # The module brakes a little before its limit, and the motor is off in the end.
    assert 0.85 < ended[0].world.plant.q_rad[1] < 0.9


def test_a_held_joint_that_gives_way_is_accused_and_no_healthy_imu_beyond_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its limits refuse all its motions, so that the model has no axis of it; the arm's load turns it."""
    shown = list[str]()
    monkeypatch.setattr(ViewerFeed, "step", lambda feed, session_ns, text: shown.append(text))
    config = VirtualConfig(
        load_robot("arm6"),
        tmp_path / "run",
        network="none",
        plan=QUICK_PLAN,
        safety={"A-3": Safety(position_rad=(-0.05, 0.05))},
    )
    result = run_virtual(config)
    assert result.suspicions
    assert all(text.startswith("A-3: the turn of its joint") for text in result.suspicions)
    assert result.excluded == []
    assert shown[-1].startswith("done; the result is not to be believed as usual: A-3")


def test_joints_are_explored_one_by_one_if_one_cannot_move_along(tmp_path: Path) -> None:
    """By the limits of the tip, which is still as if it were held."""
    config = VirtualConfig(
        load_robot("thesis_171_horizontal"),
        tmp_path / "run",
        plan=QUICK_PLAN.model_copy(update={"mode": "simultaneous"}),
        safety={"X-00010": Safety(position_rad=(-0.05, 0.05))},
    )
    result = run_virtual(config)
    assert result.serials == ["X-00009", "X-00010"]
    assert {one.serial: one.joint_moved for one in result.topology} == {"X-00009": True, "X-00010": False}
    truth = link_lengths(true_chain(config.robot), np.eye(12))[0]
    (link,) = result.links
    assert link.link_length_sigma_mm is not None
    assert abs(link.link_length_mm - 1e3 * np.nanmax(truth)) < 4.0 * link.link_length_sigma_mm
