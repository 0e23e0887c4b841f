"""Whether the robot on the network is the one that is known, and stands as it stood then."""

import asyncio
from typing import NamedTuple

import numpy as np

from coordinator.live_robot.messenger import Clock, Messenger
from coordinator.live_robot.module_group import POLL_S, ModuleGroup
from coordinator.torque_control.gravity_model import GravityModel
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import RobotError
from module_agent.model.forward_kinematics import imu_poses

# For the first module, and from one to the next.
DISCOVER_S, QUIET_S = 12.0, 3.0
# A new hub is found by agents within a second or so of one another; what is no part of the known robot is
# waited for as long.
STRANGERS_S = 0.5
# A module that nobody holds sends its rows all the same; a network may lose some.
FEEDBACK_S = 2.0
# How far from where the chain has it an IMU may feel gravity: errors as delivered are under 3 degrees, and a
# joint that has lost its zero is off by more.
MAX_TILT_RAD = float(np.radians(12.0))


class RobotMismatch(RobotError):
    """The robot is another one than the known, or stands otherwise; the message names the module."""


class Felt(NamedTuple):
    """What is felt at rest, of n modules: joint positions (n,) and specific forces (n, 3) [m/s^2]."""

    q_rad: Array
    accel_m_s2: Array


async def find_baseline_robot(
    link: ModuleGroup, radio: Messenger, weight: GravityModel, clock: Clock
) -> None:
    """Wait until the robot is there, meet it, and make sure that it is the one that is known.

    Serials and types are to be the same; boots may differ.

    Raises:
        NotTheKnownRobot: a module is missing, of another type, mute, or no part of it.
    """
    known = set(weight.chain.serials)
    await _gathered(radio, known, clock)
    if missing := sorted(known - radio.alive):
        there = ", ".join(sorted(radio.alive)) or "none"
        raise RobotMismatch(
            f"module {missing[0]} is not there, {len(missing)} of {len(known)} are missing; there are {there}"
        )
    await asyncio.sleep(STRANGERS_S)
    if strange := sorted(radio.alive - known):
        raise RobotMismatch(
            f"module {strange[0]} is no part of the robot that is known, {', '.join(weight.chain.serials)}: "
            "what it weighs is not known either; identify the robot again"
        )
    await link.meet(weight.chain.serials)
    for serial, kind in zip(weight.chain.serials, weight.types, strict=True):
        told = link.info(serial).module_type
        if told != kind:
            raise RobotMismatch(f"module {serial} is an {told}, in the robot that is known it was an {kind}")
    if not await link.wait(lambda: not _mute(link), FEEDBACK_S):
        raise RobotMismatch(f"module {_mute(link)[0]} answers, but sends no feedback")


async def _gathered(radio: Messenger, known: set[str], clock: Clock) -> None:
    """Wait until all are there, or no more come."""
    present, end_ns = set(radio.alive), clock() + int((QUIET_S if radio.alive else DISCOVER_S) * 1e9)
    while not known <= radio.alive and clock() < end_ns:
        await asyncio.sleep(POLL_S)
        if radio.alive != present:
            present, end_ns = set(radio.alive), clock() + int(QUIET_S * 1e9)


def check_mounting(chain: Chain, felt: Felt) -> None:
    """Check that every IMU feels gravity where the chain has it.

    Raises:
        NotTheKnownRobot: one does not: the base stands otherwise, or a joint counts from another zero.
    """
    poses = imu_poses(chain, felt.q_rad[None])[0]
    wanted = np.swapaxes(poses[:, :3, :3], 1, 2) @ chain.gravity
    across = np.linalg.norm(np.cross(felt.accel_m_s2, wanted), axis=1)
    tilt = np.arctan2(across, np.sum(felt.accel_m_s2 * wanted, axis=1))
    worst = int(np.argmax(tilt))
    if tilt[worst] > MAX_TILT_RAD:
        raise RobotMismatch(
            f"the IMU of module {chain.serials[worst]} feels gravity {np.degrees(tilt[worst]):.0f} degrees "
            "from where the robot that is known would have it: the base stands otherwise, or a joint has "
            "lost its zero; identify it again"
        )


def _mute(link: ModuleGroup) -> list[str]:
    return [serial for serial in link.serials if not link.module(serial).arrivals]
