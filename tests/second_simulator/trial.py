"""One robot of the second simulator, from its drawing to the errors of its result."""

from pathlib import Path
from typing import NamedTuple

from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify
from coordinator.recording.run_folder import load_recording
from tests.second_simulator.comparison import LinkError, link_errors, topology_errors
from tests.second_simulator.robot import random_robot
from tests.second_simulator.session import write_session


class Trial(NamedTuple):
    """A robot: how many modules, which of them the topology has wrong, and its links' errors if none."""

    modules: int
    wrong: list[str]
    links: list[LinkError]


def trial(folder: Path, seed: int, plan: Plan) -> Trial:
    """Record a session of the robot of a seed in a folder, and identify the robot from the recording."""
    robot = random_robot(seed)
    result = identify(load_recording(write_session(folder, robot, plan, seed))).result
    wrong = topology_errors(result, robot)
    return Trial(len(robot.serials), wrong, [] if wrong else link_errors(result, robot))
