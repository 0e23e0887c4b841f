"""An arm that knows its inertia is handed something: mass and centre against the truth."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.identify import Kinematics, identify_kinematics
from coordinator.kinematics.forward import BASE
from coordinator.known_robot import KnownRobot
from coordinator.payload_search import payload_plan, search_payload
from coordinator.plan import Plan
from coordinator.urdf import link_homes
from module_agent.dynamics.chain import Array, Chain
from module_agent.wire.network_file import network
from sim.loaded import loaded
from sim.noise_profile import NoiseProfile
from sim.parts import FreePose
from sim.place import somewhere
from sim.robot_file import Robot, load_robot
from sim.robot_tree import true_chain, true_inertia
from sim.virtual_robot import VirtualSettings
from sim.virtual_session import record_session

MASS_KG = 0.2
# About as large as a fist, and beside the flange.
HELD = FreePose(mass_kg=MASS_KG, com_xyz_m=(0.04, 0.0, 0.02), inertia=(1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0))


class PayloadTrial(NamedTuple):
    """What came of one search: whether a payload was found, and on the body that carries it.

    mass_error: relative. com_error_m: by the last axis and the one before it. motion_s: how long the robot
    was moved for it.
    """

    robot: str
    seed: int
    found: bool
    on_its_body: bool
    mass_error: float
    com_error_m: float
    motion_s: float


def payload_trial(
    robot: str, noise: str | NoiseProfile, seed: int, plan: Plan, carries: bool = True
) -> PayloadTrial:
    """Let a robot find out its inertia, hand it a payload, or nothing, and ask it what that is.

    Raises:
        what the session raises, and `PayloadError`.
    """
    bare = somewhere(load_robot(robot), seed)
    carrier = bare.serials[-1]
    full = loaded(bare, carrier, HELD)
    known = _lived(bare, noise, seed, 0, plan)
    later = _lived(full if carries else bare, noise, seed, 1, payload_plan(known, Plan()))
    report = search_payload(known, later)
    if not report.found or not carries:
        return PayloadTrial(robot, seed, report.found, False, np.nan, np.nan, report.motion_s)
    added = (true_inertia(full) - true_inertia(bare))[-1]
    there = _from_axis(true_chain(bare), added[1:4] / added[0])
    body = known.chain.serials.index(report.carrier)
    centre = (link_homes(known.chain)[body] @ np.append(1e-3 * np.array(report.com_mm), 1.0))[:3]
    apart = _from_axis(known.chain, centre) - there
    return PayloadTrial(
        robot,
        seed,
        True,
        report.carrier == carrier,
        report.mass_kg / MASS_KG - 1.0,
        float(np.linalg.norm(apart)),
        report.motion_s,
    )


def _lived(robot: Robot, noise: str | NoiseProfile, seed: int, day: int, plan: Plan) -> KnownRobot:
    """Return a robot after a session; the same seed has the same modules, another day other noise."""
    settings = VirtualSettings(robot, network("lan"), seed, noise, noise_seed=1000 * seed + day)
    recording = record_session(settings, plan)
    kinematics: Kinematics = identify_kinematics(recording)
    return KnownRobot(Path(f"day {day}"), recording, kinematics)


def _from_axis(chain: Chain, place_m: Array) -> Array:
    """Return a place (3,) by the last axis and the one before it: the root frame is known but for a turn.

    x across both axes, z along the last one, from where the last axis is nearest to the one before.
    """
    body = len(chain.serials) - 1
    before = chain.parent[body]
    if before == BASE:
        raise ValueError(f"{chain.serials[body]} is alone: nothing tells where its axis begins")
    z, other = chain.axis[body], chain.axis[before]
    x = np.cross(other, z)
    x = x / np.linalg.norm(x)
    along, _, _ = np.linalg.solve(np.column_stack([z, -other, x]), chain.point[before] - chain.point[body])
    off = place_m - (chain.point[body] + along * z)
    return np.array([off @ x, off @ np.cross(z, x), off @ z])
