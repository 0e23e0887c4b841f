"""Payloads: one is detected on the right body, with its mass and centre; without one none is detected."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.baseline.baseline_robot import BaselineRobot
from coordinator.baseline.payload import payload_plan, search_payload
from coordinator.description.urdf_writer import link_homes
from coordinator.excitation.plan import Plan
from module_agent.model.chain import BASE, Array, Chain
from module_agent.network_emulation.profile_file import network
from sim.benchmark.case import Case, Summary, Trial, trial_seeds
from sim.benchmark.cases.inertia import identified_session, known_of, plan_of, shared_session
from sim.benchmark.cases.link_change import known_robot
from sim.benchmark.row import Row, count, largest, scaled
from sim.geometry.link_parts import FreePose
from sim.imperfections.noise_profile import NoiseProfile, noise_profile
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import true_chain, true_inertia
from sim.robot.variants import as_built, at_random_site, loaded
from sim.virtual_time.robot import VirtualSettings

MASS_KG = 0.2
# About as large as a fist, off the flange's axis.
HELD = FreePose(mass_kg=MASS_KG, com_xyz_m=(0.04, 0.0, 0.02), inertia=(1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0))


class PayloadTrial(NamedTuple):
    """The result of one search for a payload.

    found: a payload was reported; on_its_body: on the right body. mass_error: relative. com_error_m: in the
    frame of the last axis and the one before it. motion_s: duration of the motion.
    """

    robot: str
    seed: int
    found: bool
    on_its_body: bool
    mass_error: float
    com_error_m: float
    motion_s: float


def payload_trial(
    robot: str,
    noise: str | NoiseProfile,
    seed: int,
    plan: Plan,
    carries: bool = True,
    shared: bool = False,
) -> PayloadTrial:
    """Identify a robot, add a payload or none, and search for it.

    shared: the robot is known from the session of `inertia_trial`.

    Raises:
        PayloadError: the runs do not suffice for a search.
    """
    unloaded = at_random_site(as_built(load_robot(robot), seed, noise), seed)
    carrier = unloaded.serials[-1]
    full = loaded(unloaded, carrier, HELD)
    known = _known(robot, noise, seed, plan) if shared else _recorded(unloaded, noise, seed, 0, plan)
    later = _recorded(full if carries else unloaded, noise, seed, 1, payload_plan(known, Plan()))
    report = search_payload(known, later)
    if not report.found or not carries:
        return PayloadTrial(robot, seed, report.found, False, np.nan, np.nan, report.motion_s)
    added = (true_inertia(full) - true_inertia(unloaded))[-1]
    there = _from_axis(true_chain(unloaded), added[1:4] / added[0])
    body = known.chain.serials.index(report.carrier)
    centre = (link_homes(known.chain)[body] @ np.append(1e-3 * np.array(report.com_mm), 1.0))[:3]
    offset = _from_axis(known.chain, centre) - there
    return PayloadTrial(
        robot,
        seed,
        True,
        report.carrier == carrier,
        report.mass_kg / MASS_KG - 1.0,
        float(np.linalg.norm(offset)),
        report.motion_s,
    )


def _known(robot: str, noise: str | NoiseProfile, seed: int, plan: Plan) -> BaselineRobot:
    session = identified_session(robot, noise, seed, plan)
    return BaselineRobot(Path("day 0"), session.recording, session.identified.kinematics)


def _recorded(robot: Robot, noise: str | NoiseProfile, seed: int, day: int, plan: Plan) -> BaselineRobot:
    """Record a session of a robot; another day of the same seed has the same modules and other noise."""
    settings = VirtualSettings(robot, network("lan"), seed, noise, noise_seed=1000 * seed + day)
    return known_robot(settings, plan, day)


def _from_axis(chain: Chain, point_m: Array) -> Array:
    """Return a point (3,) in the frame of the last two axes, since the root frame is known up to a rotation.

    x across both axes, z along the last one, from where the last axis is nearest to the one before.
    """
    body = len(chain.serials) - 1
    before = chain.parent[body]
    if before == BASE:
        raise ValueError(f"{chain.serials[body]} has no parent: no frame of two axes")
    z, other = chain.axis[body], chain.axis[before]
    x = np.cross(other, z)
    x = x / np.linalg.norm(x)
    along, _, _ = np.linalg.solve(np.column_stack([z, -other, x]), chain.point[before] - chain.point[body])
    off = point_m - (chain.point[body] + along * z)
    return np.array([off @ x, off @ np.cross(z, x), off @ z])


ROBOT = "a2085_06"
PROFILES = ("x5", "x5-uncalibrated")
MASS_PERCENT, COM_MM, MOTION_S = 3.0, 5.0, 15.0
_COST_S, _QUICK_COST_S = 26.0, 4.0


def payload_cases(trials: int, seed: int, shortened: bool = False) -> list[Case]:
    """Return the case of a payload under each profile, and with more than one trial that of none.

    `shortened`: of the robots whose inertia is measured, known from the same session.
    """
    cost_s = _QUICK_COST_S if shortened else _COST_S

    def case(
        name: str, profile: str, carries: bool, rows: Callable[[Sequence[PayloadTrial]], Summary]
    ) -> Case:
        noise = noise_profile(profile)
        work = [
            Trial(
                payload_trial,
                (ROBOT, noise, own, plan_of(noise, shortened), carries, shortened),
                cost_s,
                shared_session(ROBOT, profile, own) if shortened else "",
            )
            for own in trial_seeds(seed, ROBOT if shortened else name, trials)
        ]
        label = name if profile == "x5" else f"{name}, {profile}"
        return Case(label, work, rows, profile, f"a run without it, {known_of(noise)}")

    cases = [case(f"{ROBOT}, payload of 0.2 kg", profile, True, _loaded_rows) for profile in PROFILES]
    return cases if shortened else [*cases, case(f"{ROBOT}, no payload", "x5", False, _unloaded_rows)]


def _loaded_rows(trials: Sequence[PayloadTrial]) -> Summary:
    found = [trial for trial in trials if trial.found]
    mass_percent = scaled(largest([t.mass_error for t in found]), 100.0)
    centre_mm = scaled(largest([t.com_error_m for t in found]), 1e3)
    return Summary(
        [
            count("payloads not found, or on another body", [not t.on_its_body for t in trials]),
            Row("mass, worst [%]", mass_percent, MASS_PERCENT),
            Row("centre, worst [mm]", centre_mm, COM_MM),
            Row("motion, longest [s]", largest([t.motion_s for t in trials]), MOTION_S),
        ]
    )


def _unloaded_rows(trials: Sequence[PayloadTrial]) -> Summary:
    return Summary([count("payloads found where none is", [t.found for t in trials])])
