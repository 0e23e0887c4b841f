"""Preconditions of gravity compensation: the modelled robot is there, in the modelled orientation."""

import asyncio

import numpy as np

from coordinator.live_robot.discovery import await_modules
from coordinator.live_robot.messenger import Clock, Messenger
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.torque_control.gravity_model import GravityModel
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import RobotError
from module_agent.model.forward_kinematics import imu_poses

# For the first module, and from one to the next.
DISCOVER_S, QUIET_S = 12.0, 3.0
# Agents find a new hub within a second of one another; how long to wait for modules outside the model.
UNKNOWN_MODULES_S = 0.5
# Modules send feedback without a lease; a network may lose some.
FEEDBACK_S = 2.0
# Largest angle between measured and modelled gravity of an IMU; errors as delivered are under 3 degrees.
MAX_TILT_RAD = float(np.radians(12.0))


class RobotMismatch(RobotError):
    """The robot is not the modelled one, or oriented differently; the message names the module."""


async def find_robot(group: ModuleGroup, messenger: Messenger, model: GravityModel, clock: Clock) -> None:
    """Wait until all modules of the model are there, and check that serials and types are the same.

    Raises:
        RobotMismatch: a module is missing, has another type, sends no feedback, or is not in the model.
    """
    known = set(model.chain.serials)
    await await_modules(
        messenger,
        clock,
        lambda present, quiet_s: known <= present or quiet_s >= (QUIET_S if present else DISCOVER_S),
    )
    if missing := sorted(known - messenger.alive):
        there = ", ".join(sorted(messenger.alive)) or "none"
        raise RobotMismatch(
            f"module {missing[0]} is missing ({len(missing)} of {len(known)} are); present: {there}"
        )
    await asyncio.sleep(UNKNOWN_MODULES_S)
    if unknown := sorted(messenger.alive - known):
        raise RobotMismatch(
            f"module {unknown[0]} is not in the model, which has {', '.join(model.chain.serials)}; identify "
            "the robot again with it"
        )
    await group.meet(model.chain.serials)
    for serial, kind in zip(model.chain.serials, model.types, strict=True):
        reported = group.info(serial).module_type
        if reported != kind:
            raise RobotMismatch(f"module {serial} is of type {reported}, in the model it is {kind}")
    if not await group.wait(lambda: not group.without_feedback(), FEEDBACK_S):
        raise RobotMismatch(f"module {group.without_feedback()[0]} answers, but sends no feedback")


def check_gravity(chain: Chain, q_rad: Array, accel_m_s2: Array) -> None:
    """Check the direction of gravity that every IMU measures at rest, (n, 3), against the model.

    Raises:
        RobotMismatch: one deviates: the base is oriented differently, or a joint has lost its zero.
    """
    poses = imu_poses(chain, q_rad[None])[0]
    wanted = np.swapaxes(poses[:, :3, :3], 1, 2) @ chain.gravity
    across = np.linalg.norm(np.cross(accel_m_s2, wanted), axis=1)
    tilt = np.arctan2(across, np.sum(accel_m_s2 * wanted, axis=1))
    worst = int(np.argmax(tilt))
    if tilt[worst] > MAX_TILT_RAD:
        raise RobotMismatch(
            f"the IMU of module {chain.serials[worst]} measures gravity {np.degrees(tilt[worst]):.0f} deg "
            f"from the model, at most {np.degrees(MAX_TILT_RAD):.0f} deg are accepted: the base is oriented "
            "differently, or a joint has lost its zero; identify the robot again"
        )
