"""A simulated robot floats: it stays where it is left, a hand leads it, and limits hold it."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import pytest

from coordinator.live_robot.errors import ModuleLost, RobotStopped
from coordinator.live_robot.messenger import Refused, Sender
from coordinator.torque_control.gravity_compensation import (
    CompensationRefused,
    CompensationSettings,
    GravityCompensator,
    StaleFeedback,
)
from coordinator.torque_control.gravity_model import GravityModel
from coordinator.torque_control.preconditions import RobotMismatch
from coordinator.torque_control.session import CompensationPlan, CompensationSession, Moment
from module_agent.model.chain import Array
from module_agent.network_emulation.profile import NetworkProfile
from module_agent.transport.transport import TransportError
from sim.benchmark.cases.gravity_compensation import (
    POSES,
    CompensationTrial,
    Pose,
    compensate_robot,
    compensation_trial,
    posed,
    true_weight,
)
from sim.geometry.link_parts import FreePose
from sim.imperfections.noise_profile import NOISE_PROFILES, switched
from sim.robot.robot_file import Robot, load_robot
from sim.world.external_force import Push

# Tests of this group share recorded runs: they stay in one process.
pytestmark = pytest.mark.xdist_group("gravity_compensation")

ARM = "a2085_03"
LIFT, ELBOW = "shoulder-lift", "elbow"
BENT = Pose("bent", {LIFT: 0.7, ELBOW: -0.8})
LONG = CompensationPlan(for_s=5.0)
SHORT = CompensationPlan(for_s=1.0, final_hold_s=0.2)
UNTIL_HELD = ["loading", "loaded", "releasing", "compensating", "holding", "held"]
IDEAL = NOISE_PROFILES["ideal"]
LOSSLESS = switched(IDEAL, (), ("friction", "gear-loss"))


def weight() -> GravityModel:
    return true_weight(load_robot(ARM))


# --------------------------------------------------------------------------- floating


@cache
def tried() -> CompensationTrial:
    return compensation_trial(1, load_robot(ARM), weight(), "x5", drift_s=5.0, poses=(BENT,))


def test_left_alone_an_arm_stays_where_it_is() -> None:
    # Measured 0.5 degrees in 10 s: sensors and springs err by some percent of a weight that friction holds.
    assert tried().drift_deg < 1.5


def test_a_light_hand_leads_it_and_where_it_is_left_it_stays() -> None:
    # 4 N for 0.6 s.
    assert tried().guided_deg > 15.0
    assert tried().rest_deg < 1.5


def test_a_hand_that_leads_a_free_arm_does_not_move_one_that_is_held() -> None:
    assert tried().guiding_n < 2.0
    assert tried().held_n > 5.0 * tried().guiding_n


def test_without_friction_it_creeps_by_what_the_feed_forward_takes_the_gear_to_lose() -> None:
    # The modules' feed-forward counts on 65 % of the motor's torque; of a gear without loss it gets all, and
    # the effort loop leaves a tenth of that error. With the motors' friction the same arm stands still.
    start = posed(load_robot(ARM), BENT.start_rad)
    plan = CompensationPlan(for_s=2.5, final_hold_s=0.0, returns=False)
    creeping, standing = (
        compensate_robot(start, weight(), plan, 1, noise).released() for noise in (LOSSLESS, IDEAL)
    )
    rate = np.abs(creeping.q_rad[-1] - creeping.q_rad[0]).max() / np.ptp(creeping.t_s)
    # Measured 2.9 degrees a second.
    assert 0.5 < np.degrees(rate) < 5.0
    assert np.degrees(np.ptp(standing.q_rad, axis=0).max()) < 0.05


def test_a_damper_makes_the_arm_follow_a_hand_more_slowly() -> None:
    start = posed(load_robot(ARM), BENT.start_rad)
    push = Push(serial=ELBOW, force_n=(0.0, 0.0, 2.0), from_s=3.0, for_s=0.3)
    gone = []
    for damping in (0.0, 1.2):
        plan = CompensationPlan(CompensationSettings(damping), for_s=2.0, final_hold_s=0.0, returns=False)
        free = compensate_robot(start, weight(), plan, 1, IDEAL, pushes=(push,)).released()
        gone.append(np.ptp(free.q_rad[free.t_s > 2.9], axis=0).max())
    # Without it the motors' own friction and back-EMF are what brakes.
    assert np.degrees(gone[0]) > 5.0
    assert gone[1] < 0.6 * gone[0]


def test_it_floats_over_a_network_that_loses_and_delays() -> None:
    poor = compensate_robot(posed(load_robot(ARM), BENT.start_rad), weight(), SHORT, 2, "x5", "wifi")
    assert not poor.summary.is_fault
    assert poor.summary.compensated_s == pytest.approx(1.0, abs=0.05)
    assert np.degrees(np.ptp(poor.released().q_rad, axis=0).max()) < 1.5


def test_in_the_end_it_is_led_back_to_where_it_stood() -> None:
    start = posed(load_robot(ARM), BENT.start_rad)
    push = Push(serial=ELBOW, force_n=(0.0, 0.0, 3.0), from_s=3.0, for_s=0.4)
    done = compensate_robot(start, weight(), SHORT._replace(for_s=2.0), 1, "x5", pushes=(push,))
    joints = {joint.serial: joint for joint in done.summary.joints}
    assert not done.summary.is_fault
    assert abs(joints[LIFT].end_rad - joints[LIFT].start_rad) > 0.2
    assert joints[LIFT].farthest_rad >= abs(joints[LIFT].end_rad - joints[LIFT].start_rad)
    # Within what the springs and loops give under its weight.
    assert np.degrees(np.abs(done.q_rad[-1] - done.q_rad[0]).max()) < 2.0
    # Virtual time: no set-point is late.
    assert done.summary.missed == 0


# --------------------------------------------------------------------------- limits


def test_a_push_that_is_too_fast_ends_it_and_the_arm_is_held_there() -> None:
    start = posed(load_robot(ARM), BENT.start_rad)
    shove = Push(serial=ELBOW, force_n=(0.0, 0.0, 25.0), from_s=3.0, for_s=0.4)
    plan = CompensationPlan(CompensationSettings(max_speed_rad_s=0.6), for_s=5.0, final_hold_s=1.0)
    done = compensate_robot(start, weight(), plan, 1, "x5", pushes=(shove,))
    assert done.summary.is_fault
    assert "rad/s, at most 0.60 rad/s are allowed" in done.summary.why
    held = done.q_rad[np.array([phase == "held" for phase in done.phases])]
    # The shove goes on a little; then it stands.
    assert np.ptp(held[-100:], axis=0).max() < 0.01
    # Whoever pushed it may be where it came from.
    assert "returning" not in done.phases


def laden(mass_kg: float, pose: Pose) -> Robot:
    bare = load_robot(ARM)
    tool = FreePose(mass_kg=mass_kg, com_xyz_m=(0.0, 0.0, 0.05), inertia=(1e-3, 1e-3, 1e-3, 0.0, 0.0, 0.0))
    last = bare.modules[-1].model_copy(update={"payload": tool})
    return posed(bare.model_copy(update={"modules": (*bare.modules[:-1], last)}), pose.start_rad)


@pytest.mark.parametrize("mass_kg", [0.5, 1.0])
@pytest.mark.parametrize("pose", POSES, ids=lambda pose: pose.name)
def test_an_arm_with_a_tool_that_is_not_known_is_refused_before_anything_moves(
    mass_kg: float, pose: Pose
) -> None:
    with pytest.raises(CompensationRefused, match=f"joint {LIFT}: measured .* model predicts"):
        compensate_robot(laden(mass_kg, pose), weight(), SHORT, 1, "x5-uncalibrated")


@pytest.mark.parametrize("pose", POSES, ids=lambda pose: pose.name)
def test_a_tool_that_is_noticed_only_when_the_arm_has_been_taken_is_held_and_does_not_fall(
    pose: Pose, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Hung on it between the first look and the first set-point.
    monkeypatch.setattr(GravityCompensator, "check_start", lambda *_: None)
    done = compensate_robot(laden(1.0, pose), weight(), SHORT, 1, "x5-uncalibrated")
    assert done.summary.is_fault
    assert "Remove any payload or contact" in done.summary.why
    assert list(dict.fromkeys(done.phases)) == ["holding", "held"]
    sag = np.degrees(np.abs(done.q_rad - done.q_rad[0]).max())
    speed = np.abs(np.diff(done.q_rad, axis=0) / np.diff(done.t_s)[:, None]).max()
    # Measured 1.4 degrees, and 0.4 rad/s, at which it sinks by itself as it is taken.
    assert sag < 3.0
    assert speed < 0.6


@pytest.mark.parametrize("seed", range(4))
def test_sensors_as_delivered_keep_no_arm_from_floating(seed: int) -> None:
    robot = posed(load_robot(ARM), BENT.start_rad)
    plan = SHORT._replace(for_s=0.1, returns=False)
    done = compensate_robot(robot, weight(), plan, seed, "x5-uncalibrated")
    assert (done.summary.is_fault, done.summary.why) == (False, "the time is over")


def test_a_heavy_arm_that_sinks_while_its_motors_are_off_is_taken_and_set_free() -> None:
    # Its second joint bears 6.8 Nm, and sinks at 0.6 rad/s as it is taken.
    robot = load_robot("arm6")
    plan = SHORT._replace(for_s=0.1, returns=False)
    done = compensate_robot(robot, true_weight(robot), plan, 1, "x5-uncalibrated")
    assert (done.summary.is_fault, done.summary.why) == (False, "the time is over")


def test_an_arm_that_something_comes_to_hang_on_while_it_is_being_loaded_is_not_set_free() -> None:
    robot = posed(load_robot(ARM), BENT.start_rad)
    began_s = compensate_robot(robot, weight(), SHORT, 1, "x5").t_s[0]
    hung = Push(serial=ELBOW, force_n=(0.0, 0.0, -3.0), from_s=began_s + 0.25, for_s=20.0)
    done = compensate_robot(robot, weight(), SHORT, 1, "x5", pushes=(hung,))
    assert done.summary.is_fault
    assert "releasing" not in done.phases
    # Measured 9.6 degrees: the load over the stiffness of the factory's position control.
    assert np.degrees(np.abs(done.q_rad - done.q_rad[0]).max()) < 12.0


def test_a_base_that_stands_on_its_side_is_not_set_free() -> None:
    robot = load_robot(ARM)
    base = robot.base.model_copy(update={"mount": None, "rpy_deg": (0.0, 25.0, 0.0)})
    with pytest.raises(RobotMismatch, match="measures gravity 25 deg"):
        compensate_robot(robot.model_copy(update={"base": base}), weight(), SHORT, 1, "x5")


def test_an_arm_that_is_too_heavy_where_it_stands_is_refused_before_anything_moves() -> None:
    robot = load_robot(ARM)
    heavy = weight()._replace(phi=40.0 * weight().phi)
    with pytest.raises(CompensationRefused, match=r"joint shoulder-lift: this pose needs -?\d\d"):
        compensate_robot(robot, heavy, SHORT, 1, "x5")


# --------------------------------------------------------------------------- modules that fail


@dataclass
class Seen:
    """A watcher that keeps phases and notes."""

    phases: list[str] = field(default_factory=list)
    efforts: list[Array] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        self.notes.append(text)

    def moment(self, now: Moment) -> None:
        self.phases.append(now.phase)
        self.efforts.append(now.effort_nm)

    @property
    def floats(self) -> bool:
        return "compensating" in self.phases

    @property
    def order(self) -> list[str]:
        return [p for k, p in enumerate(self.phases) if k == 0 or self.phases[k - 1] != p]


def session(rig: Any, plan: CompensationPlan = LONG) -> tuple[CompensationSession, Seen]:
    seen, loop = Seen(), rig.loop
    made = CompensationSession(
        rig.endpoint("float"), ARM, weight(), plan, lambda: loop.now_ns, loop.call_soon, seen, Sender("float")
    )
    return made, seen


def test_when_an_agent_dies_the_others_are_told_to_stop_and_it_is_named(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    floating, seen = session(rig)
    rig.when(lambda: seen.floats, lambda: rig.kill(ELBOW))
    with pytest.raises(StaleFeedback, match=f"module {ELBOW}: newest feedback is 20"):
        rig.run(floating.run())
    assert [rig.state(serial) for serial in rig.hosts] == ["stopped", "stopped"]
    assert seen.notes[-1].startswith("stopped: module elbow: newest feedback is ")


def test_an_agent_that_hangs_while_gains_are_given_is_noticed_by_its_feedback(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not when its answer is overdue: the other joints follow the last torques as long as that takes."""
    rig = rigs(ARM, "lan")
    floating, _ = session(rig)
    set_gains, hung_s, stopped_s = floating._group.set_gains, list[float](), list[float]()

    async def hanging(serial: str, *what: Any) -> None:
        if not hung_s:
            hung_s.append(rig.loop.time())
            rig.freeze(ELBOW)
        await set_gains(serial, *what)

    def watch() -> None:
        if rig.state(LIFT) == "stopped" and not stopped_s:
            stopped_s.append(rig.loop.time())

    monkeypatch.setattr(floating._group, "set_gains", hanging)
    rig.on_tick.append(watch)
    with pytest.raises(StaleFeedback, match=f"module {ELBOW}: newest feedback is 20"):
        rig.run(floating.run())
    assert stopped_s[0] - hung_s[0] < 0.25


def test_somebody_elses_stop_ends_it_and_is_not_overruled(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    floating, seen = session(rig)
    messenger, _, other = rig.group("other")

    async def both() -> None:
        work = asyncio.ensure_future(floating.run())
        while not seen.floats:
            await asyncio.sleep(0.05)
        await other.meet([LIFT])
        await messenger.stop(LIFT, other.commander.sender, "enough")
        await work

    with pytest.raises(RobotStopped, match=f"module {LIFT} was stopped by other: enough"):
        rig.run(both())
    assert {rig.state(serial) for serial in rig.serials} == {"stopped"}


def test_when_the_host_stalls_the_modules_let_go_by_themselves(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    floating, seen = session(rig)
    cut_s: list[float] = []

    def cut() -> None:
        rig.network.kill("float")
        cut_s.append(rig.loop.time())

    rig.when(lambda: seen.floats, cut)
    with pytest.raises(TransportError):
        rig.run(floating.run())
    # The commands' life is 250 ms.
    rig.run(_until(rig, cut_s[0] + 0.3))
    assert {rig.state(serial) for serial in rig.serials} == {"expired"}


async def _until(rig: Any, t_s: float) -> None:
    await asyncio.sleep(max(0.0, t_s - rig.loop.time()))


def test_no_joint_is_off_where_a_module_takes_longer_to_take_than_a_lease_lasts(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rigs(ARM, "lan")
    floating, seen = session(rig, CompensationPlan(for_s=0.3, final_hold_s=0.0, returns=False))
    acquire = floating._group.commander.acquire

    async def slow(serial: str) -> None:
        if serial == ELBOW:
            await asyncio.sleep(0.6)
        await acquire(serial)

    monkeypatch.setattr(floating._group.commander, "acquire", slow)
    off: set[str] = set()

    def watch() -> None:
        off.update(serial for serial in rig.serials if rig.state(serial) == "expired")

    rig.on_tick.append(watch)
    assert rig.run(floating.run()).why == "the time is over"
    assert seen.floats
    assert off == set()


@pytest.mark.parametrize("state", ["armed", "expired"])
def test_a_joint_that_executes_no_set_point_from_the_start_ends_it(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, state: str
) -> None:
    """Its lease is renewed or not: all that it gets are no set-points."""
    rig = rigs(ARM, "lan")
    floating, seen = session(rig)
    stream, renew = floating._group.stream, floating._group.commander.renew

    def deaf(serial: str, *aims: float | None) -> None:
        if serial != LIFT:
            stream(serial, *aims)

    monkeypatch.setattr(floating._group, "stream", deaf)
    if state == "expired":
        until_s = 0.5
        monkeypatch.setattr(
            floating._group.commander,
            "renew",
            lambda **how: renew(**how) if rig.loop.time() < until_s else None,
        )
    with pytest.raises(ModuleLost, match=f"module {LIFT} is lost: .* {state}"):
        rig.run(floating.run())
    assert not seen.floats
    assert {rig.state(serial) for serial in rig.serials} <= {"stopped", "expired"}


def test_a_module_that_somebody_holds_is_not_taken_from_him(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    floating, _ = session(rig)
    _, _, other = rig.group("other")

    async def both() -> None:
        await asyncio.sleep(0.1)
        await other.meet([LIFT])
        await other.acquire(LIFT)
        await floating.run()

    with pytest.raises(Refused, match=f"module {LIFT} refused lease: HELD|held by other"):
        rig.run(both())
    assert rig.state(LIFT) == "armed"


def test_asked_to_end_it_is_held_led_back_and_let_go(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, NetworkProfile(name="some", delay_ms=3.0, jitter_ms=2.0))
    floating, seen = session(rig, CompensationPlan(final_hold_s=0.2))
    rig.when(lambda: seen.phases.count("compensating") > 100, floating.end)
    found = rig.run(floating.run())
    assert found.why == "asked to end"
    assert found.compensated_s == pytest.approx(0.5, abs=0.1)
    assert {rig.state(serial) for serial in rig.serials} == {"idle"}
    assert seen.order == [*UNTIL_HELD, "returning", "held"]


def test_asked_to_end_before_it_is_free_it_is_held_as_it_was_and_let_go(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    floating, seen = session(rig)
    rig.when(lambda: len(seen.phases) > 4, floating.end)
    found = rig.run(floating.run())
    assert (found.why, found.joints) == ("asked to end", ())
    assert {rig.state(serial) for serial in rig.serials} == {"idle"}
    # Nothing has moved, so there is no way back.
    assert seen.order == ["loading", "holding", "held"]
    assert np.abs(np.diff(seen.efforts, axis=0)).max() < 0.02


def test_asked_to_end_on_its_way_back_it_stops_there_and_is_let_go(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    floating, seen = session(rig, SHORT)
    rig.when(lambda: seen.phases.count("returning") > 3, floating.end)
    found = rig.run(floating.run())
    assert (found.why, found.is_fault) == ("the time is over", False)
    assert seen.order == [*UNTIL_HELD, "returning", "holding", "held"]
    assert seen.phases.count("returning") < 12
    assert "released at its position without returning" in seen.notes[-1]
    assert {rig.state(serial) for serial in rig.serials} == {"idle"}


def test_asked_to_end_while_it_is_held_still_it_does_not_set_out(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    floating, seen = session(rig, SHORT)
    rig.when(lambda: seen.phases.count("held") > 5, floating.end)
    found = rig.run(floating.run())
    assert (found.why, found.is_fault) == ("the time is over", False)
    assert seen.order == UNTIL_HELD
    assert {rig.state(serial) for serial in rig.serials} == {"idle"}
