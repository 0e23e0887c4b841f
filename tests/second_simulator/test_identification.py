"""Random robots of the second simulator: topology, and claims about links that hold as often as they say.

`pytest -m benchmark -s tests/benchmarks/test_second_simulator.py` has twenty robots at full length.
"""

import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify
from coordinator.identification.result import Result
from coordinator.main import app
from coordinator.recording.run_folder import RESULT, load_recording
from module_agent.model.catalogue import ImuKind
from tests.second_simulator.comparison import (
    LinkError,
    lengths_covered,
    reduced_chi2,
    topology_errors,
    transforms_covered,
)
from tests.second_simulator.motion import planned_motion, torques
from tests.second_simulator.robot import random_robot
from tests.second_simulator.sensors import feedback, ideal_readings
from tests.second_simulator.session import write_session
from tests.second_simulator.trial import trial

# Trees of four, chains of two to four, with and without reversed modules: as many as are worth their time.
UNCALIBRATED, CALIBRATED = (0, 1, 4, 6), (2, 9, 19)


@pytest.mark.parametrize(("imu", "seeds"), [("uncalibrated", UNCALIBRATED), ("calibrated", CALIBRATED)])
def test_links_of_random_robots_are_where_their_intervals_say(
    tmp_path: Path, quick_plan: Plan, imu: ImuKind, seeds: tuple[int, ...]
) -> None:
    plan, links = quick_plan.model_copy(update={"imu": imu}), list[LinkError]()
    for seed in seeds:
        found = trial(tmp_path / str(seed), seed, plan)
        assert found.wrong == [], f"robot {seed}"
        links += found.links
    assert lengths_covered(links).honest, lengths_covered(links)
    assert transforms_covered(links).honest, transforms_covered(links)
    squares, low, high = reduced_chi2(links)
    assert low < squares < high


def test_replay_takes_a_recording_of_the_second_simulator_like_any(tmp_path: Path, quick_plan: Plan) -> None:
    robot = random_robot(9)
    session = write_session(tmp_path, robot, quick_plan, 9)
    assert load_recording(session).refused == {}
    ended = CliRunner().invoke(app, ["replay", str(session)])
    assert ended.exit_code == 0, ended.output
    result = Result.model_validate(json.loads((tmp_path / RESULT).read_text()))
    assert topology_errors(result, robot) == []


def test_torques_of_held_out_motions_are_predicted_as_pinocchio_has_them(
    tmp_path: Path, quick_plan: Plan
) -> None:
    plan = quick_plan.model_copy(update={"dynamics": True, "torque": "calibrated", "dynamic_repeats": 2})
    robot, seed = random_robot(9), 9
    held_out = identify(load_recording(write_session(tmp_path, robot, plan, seed))).held_out
    assert held_out is not None
    motion = planned_motion(robot, plan, seed)
    modules, true = feedback(robot, motion, seed, plan.imu), np.empty_like(held_out.tau_predicted_nm)
    for column, serial in enumerate(held_out.serials):
        k = robot.serials.index(serial)
        t_s = modules[k].clock.session_s(held_out.module_ns[:, column])
        true[:, column] = torques(robot, motion, t_s)[:, k]
    error = np.linalg.norm(held_out.tau_predicted_nm - true) / np.linalg.norm(true)
    # The benchmark's bar of rigid arms; their mean torques alone are off by a tenth.
    assert error < 0.01
    assert held_out.error.mean_overall > 0.1


def test_the_second_simulators_imus_read_the_motion_of_their_places(quick_plan: Plan) -> None:
    # Pinocchio's rates and accelerations against differences of its own placements, 0.1 ms apart.
    robot = random_robot(3)
    motion, data = planned_motion(robot, quick_plan, 3), robot.model.createData()
    step_s = 1e-4
    moving_s = [0.5 * (m.start_s + m.end_s) + 0.07 for m in motion.moves if m.purpose == "windowed_sine"]
    for k, frame in enumerate(robot.imus):
        for t_s in moving_s:
            poses = []
            for at_s in (t_s - step_s, t_s, t_s + step_s):
                pin.forwardKinematics(robot.model, data, motion.position(at_s))
                poses.append(pin.updateFramePlacement(robot.model, data, frame).copy())
            before, now, after = poses
            acceleration = (after.translation - 2.0 * now.translation + before.translation) / step_s**2
            force = now.rotation.T @ (acceleration - robot.model.gravity.linear)
            rate = pin.log3(before.rotation.T @ after.rotation) / (2.0 * step_s)
            (reading,) = ideal_readings(robot, motion, k, np.array([t_s]))
            np.testing.assert_allclose(reading[:3], rate, atol=1e-5)
            np.testing.assert_allclose(reading[3:], force, atol=1e-4)


def test_the_second_simulators_torques_at_rest_are_the_slope_of_its_potential_energy(
    quick_plan: Plan,
) -> None:
    robot = random_robot(3)
    motion, data = planned_motion(robot, quick_plan, 3), robot.model.createData()
    resting_s, step = motion.moves[0].start_s + 0.3, 1e-5
    q = motion.position(resting_s)
    ahead, behind = (
        np.array([pin.computePotentialEnergy(robot.model, data, q + way * row) for row in np.eye(len(q))])
        for way in (step, -step)
    )
    measured = torques(robot, motion, np.array([resting_s]))[0]
    np.testing.assert_allclose(measured, (ahead - behind) / (2.0 * step), atol=1e-6)
