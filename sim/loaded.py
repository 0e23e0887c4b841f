"""A robot that carries something: a payload on what one of its joints turns."""

from sim.parts import FreePose
from sim.robot_file import Robot


def loaded(robot: Robot, serial: str, payload: FreePose) -> Robot:
    """Return the robot with a payload on one of its modules.

    Raises:
        ValueError: the robot has no such module.
    """
    if serial not in robot.serials:
        raise ValueError(f"robot {robot.name} has no module {serial}; it has {', '.join(robot.serials)}")
    modules = [
        module.model_copy(update={"payload": payload}) if module.serial == serial else module
        for module in robot.modules
    ]
    return robot.model_copy(update={"modules": tuple(modules)})
