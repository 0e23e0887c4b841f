"""Gravity compensation in virtual time: how far an arm drifts, and what force guides it by hand.

The session of `x5-coordinator compensate` runs on a simulated robot over a simulated network; a hand is an
external force at the tip.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.identification.identified import Kinematics
from coordinator.identification.identify import identify
from coordinator.live_robot.messenger import Sender
from coordinator.torque_control.gravity_model import GravityModel, gravity_model_of_result
from coordinator.torque_control.session import CompensationPlan, CompensationSession, Moment
from coordinator.torque_control.summary import CompensationSummary
from module_agent.model.chain import Array, Chain
from module_agent.model.forward_kinematics import body_displacements
from module_agent.model.read_only import read_only
from module_agent.network_emulation.profile_file import network
from sim.benchmark.case import Case, Summary, Trial, trial_seeds
from sim.benchmark.cases.inertia import identified_session, known_of, plan_of, shared_session
from sim.benchmark.row import Row, largest, ratio
from sim.imperfections.noise_profile import NoiseProfile, noise_profile
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import true_chain, true_inertia
from sim.robot.variants import at_random_site
from sim.virtual_time.robot import VirtualRobot, VirtualSettings, virtual_robot
from sim.virtual_time.run import SilentScreen
from sim.virtual_time.session import record_session
from sim.world.external_force import Push

COORDINATOR = "coordinator"
# From the start of the world to a released robot, and half a second more.
FREE_S = 3.0
# A hand's force grows in steps, slowly enough for the springs: to 5 N on a released robot, to 60 N on a held
# one. The robot counts as guided when its tip has moved by so much.
GROWING_S, STEP_S, GUIDED_M = 5.0, 0.05, 0.02
FREE_MAX_N, HELD_MAX_N = 5.0, 60.0
# A hand that guides for a moment, and how long after it the arm has come to rest.
_GUIDE_N, _GUIDE_S, _REST_S = 4.0, 0.6, 1.0


class Pose(NamedTuple):
    """Joint positions at the start [rad]; joints that are not named start where the robot's file has them."""

    name: str
    start_rad: Mapping[str, float]


# The kit arms' poses: as they are at zero, with the elbow bent, and hanging down.
POSES = (
    Pose("level", {}),
    Pose("bent", {"shoulder-lift": 0.7, "elbow": -0.8}),
    Pose("hanging", {"shoulder-lift": -1.2}),
)


class CompensationTrial(NamedTuple):
    """The result of one trial.

    drift_deg: largest motion of a joint without external force, in any pose, in `drift_s`. guided_deg: how
    far a hand moved a joint in a moment; rest_deg: how far any joint moved in the seconds after that.
    guiding_n: the force that moves the tip by 20 mm; held_n: the same of an arm that is held in position,
    infinite if no force up to 60 N does.
    """

    drift_deg: float
    drift_s: float
    guided_deg: float
    rest_deg: float
    guiding_n: float
    held_n: float


class CompensationRun(NamedTuple):
    """One session of gravity compensation: its summary, and the true motion of the joints.

    phases: (m,) at every set-point; t_s: (m,) world time; q_rad: (m, n) true positions at these times.
    """

    summary: CompensationSummary
    phases: tuple[str, ...]
    t_s: Array
    q_rad: Array

    def released(self) -> "CompensationRun":
        """Return the part in which the robot was released."""
        free = np.array([phase == "compensating" for phase in self.phases])
        phases = tuple(phase for phase in self.phases if phase == "compensating")
        return CompensationRun(self.summary, phases, self.t_s[free], self.q_rad[free])


def compensation_trial(
    seed: int,
    robot: Robot,
    weight: GravityModel,
    noise: str | NoiseProfile | None = None,
    drift_s: float = 10.0,
    poses: Sequence[Pose] = POSES,
) -> CompensationTrial:
    """Compensate gravity in some poses; in the second (or only) one also guide the arm, and hold it.

    Raises:
        what `CompensationSession.run` raises.
    """
    free = CompensationPlan(for_s=drift_s, final_hold_s=0.0, returns=False)
    drifts = []
    for pose in poses:
        alone = compensate_robot(posed(robot, pose.start_rad), weight, free, seed, noise).released()
        drifts.append(_max_deg(alone.q_rad - alone.q_rad[0]))
    here = posed(robot, poses[min(1, len(poses) - 1)].start_rad)
    tip = here.serials[-1]
    guide = Push(serial=tip, force_n=(0.0, 0.0, _GUIDE_N), from_s=FREE_S, for_s=_GUIDE_S)
    moved = compensate_robot(here, weight, free, seed, noise, pushes=(guide,)).released()
    left = moved.q_rad[moved.t_s > FREE_S + _GUIDE_S + _REST_S]
    long = free._replace(for_s=FREE_S + GROWING_S)
    guided = compensate_robot(here, weight, long, seed, noise, pushes=_growing(tip, FREE_MAX_N))
    # Held from the moment at which it would be released.
    still = free._replace(for_s=0.0, final_hold_s=FREE_S + GROWING_S)
    held = compensate_robot(here, weight, still, seed, noise, pushes=_growing(tip, HELD_MAX_N))
    return CompensationTrial(
        drift_deg=max(drifts),
        drift_s=drift_s,
        guided_deg=_max_deg(left[0] - moved.q_rad[moved.t_s <= FREE_S][-1]),
        rest_deg=_max_deg(left - left[0]),
        guiding_n=_guiding_force_n(weight.chain, guided, FREE_MAX_N),
        held_n=_guiding_force_n(weight.chain, held, HELD_MAX_N),
    )


def _growing(serial: str, max_n: float) -> list[Push]:
    """Return a force on a module's output, upwards, that grows from nothing in small steps."""
    steps = round(GROWING_S / STEP_S)
    forces_n = [(0.0, 0.0, max_n * (k + 1) / steps) for k in range(steps)]
    return [
        Push(serial=serial, force_n=force_n, from_s=FREE_S + k * STEP_S, for_s=STEP_S)
        for k, force_n in enumerate(forces_n)
    ]


def _guiding_force_n(chain: Chain, run: "CompensationRun", max_n: float) -> float:
    """Return the force at which the tip has moved by `GUIDED_M`; infinite if it never has."""
    tip = np.append(chain.point[-1], 1.0)
    place = (body_displacements(chain, run.q_rad)[:, -1] @ tip)[:, :3]
    before = place[run.t_s <= FREE_S][-1]
    guided = (np.linalg.norm(place - before, axis=1) > GUIDED_M) & (run.t_s > FREE_S)
    if not guided.any():
        return float(np.inf)
    return float(max_n * (run.t_s[np.argmax(guided)] - FREE_S) / GROWING_S)


def _max_deg(away_rad: Array) -> float:
    return float(np.degrees(np.abs(away_rad).max()))


def true_weight(robot: Robot) -> GravityModel:
    """Return the true gravity model of a simulated robot, in place of an identified one."""
    types = tuple(module.type for module in robot.modules)
    return GravityModel(robot.name, types, true_chain(robot), read_only(true_inertia(robot).reshape(-1)))


def posed(robot: Robot, start_rad: Mapping[str, float]) -> Robot:
    """Return a robot with other start positions; joints that are not named keep theirs."""
    modules = tuple(
        m.model_copy(update={"start_rad": start_rad.get(m.serial, m.start_rad)}) for m in robot.modules
    )
    return robot.model_copy(update={"modules": modules})


def compensate_robot(
    robot: Robot,
    weight: GravityModel,
    plan: CompensationPlan,
    seed: int = 0,
    noise: str | NoiseProfile | None = None,
    network_name: str = "lan",
    pushes: Sequence[Push] = (),
) -> CompensationRun:
    """Run gravity compensation as planned, from the start positions of the robot's file.

    Raises:
        what `CompensationSession.run` raises.
    """
    settings = VirtualSettings(robot, network(network_name), seed, noise, noise_seed=1, pushes=tuple(pushes))
    with virtual_robot(settings) as virtual:
        observer, loop = _TruthAtSetPoints(virtual), virtual.loop
        endpoint, name = virtual.endpoint(COORDINATOR), robot.name
        session = CompensationSession(
            endpoint, name, weight, plan, lambda: loop.now_ns, loop.call_soon, observer, Sender(COORDINATOR)
        )
        summary = virtual.complete(session.run())
    phases, t_s, q_rad = zip(*observer.rows, strict=True)
    return CompensationRun(summary, phases, np.array(t_s), np.array(q_rad))


class _TruthAtSetPoints(SilentScreen):
    """Records phase, world time and true joint positions at every set-point."""

    def __init__(self, virtual: VirtualRobot):
        self._virtual = virtual
        self.rows: list[tuple[str, float, Array]] = []

    def moment(self, now: Moment) -> None:
        """Record one set-point."""
        plant = self._virtual.world.plant
        self.rows.append((now.phase, 1e-9 * plant.t_ns, plant.q_rad))


ROBOT = "a2085_04"
DRIFT_S, QUICK_DRIFT_S = 10.0, 3.0
# A tip at 0.7 m stays within an inch, and guiding needs a quarter of the force.
DRIFT_DEG, LIGHT = 2.0, 0.25
# Seeds follow from this name, so that results stay comparable.
_SEED_NAME = f"{ROBOT}, x5, floating, known without error"
PROFILES = ("x5", "x5-uncalibrated")
_COST_S, _QUICK_COST_S = 20.0, 7.0


def compensation_cases(trials: int, seed: int, shortened: bool = False) -> list[Case]:
    """Return a case for each profile.

    `shortened`: of one pose, for some seconds, and by the session in which the robot's inertia is measured.
    """
    cost_s = _QUICK_COST_S if shortened else _COST_S
    cases = []
    for profile in PROFILES:
        noise = noise_profile(profile)
        work = [
            Trial(
                compensated,
                (own, noise, shortened),
                cost_s,
                shared_session(ROBOT, profile, own) if shortened else "",
            )
            for own in trial_seeds(seed, ROBOT if shortened else _SEED_NAME, trials)
        ]
        name, known = f"{ROBOT}, {profile}, gravity compensation", f"a run, {known_of(noise)}"
        cases.append(Case(name, work, _summary, profile, known))
    return cases


def compensated(seed: int, noise: NoiseProfile, shortened: bool) -> CompensationTrial:
    """Identify a robot, and compensate its gravity by the result on another day."""
    plan = plan_of(noise, shortened)
    if shortened:
        session = identified_session(ROBOT, noise, seed, plan)
        weight = gravity_model_of_result(session.identified.result)
        return compensation_trial(seed, session.robot, weight, noise, QUICK_DRIFT_S, POSES[1:2])
    robot = at_random_site(load_robot(ROBOT), seed)
    explored: list[Kinematics] = []
    settings = VirtualSettings(robot, network("lan"), seed, noise, noise_seed=0)
    recording = record_session(settings, plan, on_explored=explored.append)
    weight = gravity_model_of_result(identify(recording, explored=explored[0]).result)
    return compensation_trial(seed, robot, weight, noise, DRIFT_S)


def _summary(trials: Sequence[CompensationTrial]) -> Summary:
    light = largest([ratio(trial.guiding_n, trial.held_n) for trial in trials])
    return Summary(
        [
            Row("drift without a hand, largest [deg]", largest([t.drift_deg for t in trials]), DRIFT_DEG),
            Row("force that guides the tip, largest [N]", largest([t.guiding_n for t in trials])),
            Row("the same over that of an arm held in position", light, LIGHT),
            Row("drift after guiding [deg]", largest([t.rest_deg for t in trials]), DRIFT_DEG),
        ]
    )
