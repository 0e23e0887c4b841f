"""The witness tells a brake from drive by what was stopped and armed, in whatever order messages arrive."""

from collections.abc import Mapping
from types import MappingProxyType, SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

from module_agent.wire.codec import encode
from module_agent.wire.feedback_rows import ROW, STATE_NAMES
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import Ack, Feedback, LeaseRequest, MotionCommand, Rest, Setpoint
from sim.faults.plant_witness import LIFETIME_NS, PlantWitness, _Usual
from sim.virtual_time.quiet_run import ASKED, SEEN_ROWS
from sim.world.world_kernel import PLANT_MOTOR_RAD_S, PLANT_PWM, Q_RAD, QD_RAD_S

ROBOT, SERIAL, HOLDER = "arm", "A", "coordinator"
MS = 1_000_000
LATE_NS = LIFETIME_NS + 20 * MS


class Scene:
    """A coordinator and a module that talk, and what the witness finds long after that."""

    def __init__(self, speeds: Mapping[str, float] = MappingProxyType({})) -> None:
        self.witness = PlantWitness({HOLDER: HOLDER}, {SERIAL: (-1.0, 0.5)}, speeds)
        self.now_ns = self._seq = 0
        self.winding_c = 40.0

    def accept(
        self, leaf: Leaf, action: Literal["acquire", "renew", "release"] | None = None, by: str = HOLDER
    ) -> None:
        """Let a program ask in the coordinator's name for something which the module grants."""
        self.now_ns += MS
        self._seq += 1
        at = key(ROBOT, SERIAL, leaf)
        payload = b""
        if action is not None:
            head: dict[str, Any] = {"serial": SERIAL, "boot": 1, "seq": self._seq, "sender": HOLDER}
            payload = encode(LeaseRequest(**head, token=1, echo_ns=1, action=action))
        elif leaf is Leaf.MOTION:
            head = {"serial": SERIAL, "boot": 1, "seq": self._seq, "sender": HOLDER}
            payload = encode(
                MotionCommand(**head, token=1, echo_ns=1, motion_id=1, pattern=Rest(duration_s=1.0))
            )
        self.witness.tap(self.now_ns, by, "request", at, payload)
        answer = Ack(
            serial=SERIAL,
            boot=1,
            seq=self._seq,
            re=self._seq,
            accepted=True,
            reason="",
            detail="",
            t_ns=1,
            holder=None if action == "release" else HOLDER,
            lease_left_ns=1000 * MS,
            token=1,
        )
        self.witness.tap(self.now_ns, SERIAL, "reply", at, encode(answer))

    def stream(self, by: str, position_rad: float) -> None:
        """Let a program send a set-point in the holder's name."""
        self._seq += 1
        head: dict[str, Any] = {"serial": SERIAL, "boot": 1, "seq": self._seq, "sender": HOLDER, "token": 1}
        aims: dict[str, Any] = {"position_rad": position_rad, "velocity_rad_s": None, "effort_nm": None}
        point = encode(Setpoint(**head, echo_ns=1, **aims))
        self.witness.tap(self.now_ns, by, "sample", key(ROBOT, SERIAL, Leaf.SETPOINT), point)

    def followed(self, position_rad: float, state: str = "streaming", t_ns: int = 2) -> set[str]:
        """Return what the witness notes of a module whose rows say that it follows a position."""
        rows = np.zeros(3, ROW)
        rows["position_command_rad"], rows["state"][1], rows["t_ns"] = (
            position_rad,
            STATE_NAMES.index(state),
            t_ns,
        )
        feedback = Feedback(serial=SERIAL, boot=1, seq=1, first_row=0, count=3, rows=rows.tobytes())
        self.witness.tap(self.now_ns, SERIAL, "sample", key(ROBOT, SERIAL, Leaf.FEEDBACK), encode(feedback))
        return set(self.witness.violations)

    def judged(self, pwm: float, speed_rad_s: float) -> set[str]:
        """Return what the witness notes of a motor that is driven after the lifetime of the last command."""
        seen = np.zeros((2, SEEN_ROWS, 1))
        seen[:, [PLANT_PWM, ASKED]], seen[:, PLANT_MOTOR_RAD_S] = pwm, speed_rad_s
        return self.looked(seen, self.now_ns + LATE_NS)

    def looked(self, seen: np.ndarray, from_ns: int) -> set[str]:
        """Return what the witness notes of ticks (T, rows, 1) of the motor from a time on."""
        robot: Any = SimpleNamespace(
            serials=(SERIAL,),
            world=SimpleNamespace(t_ns=from_ns + len(seen) * MS, winding_c=np.array([self.winding_c])),
            robot=SimpleNamespace(modules=[SimpleNamespace(serial=SERIAL, type="X5-9")]),
        )
        self.witness.check(robot, seen)
        return set(self.witness.violations)


def armed(speeds: Mapping[str, float] = MappingProxyType({})) -> Scene:
    scene = Scene(speeds)
    scene.accept(Leaf.LEASE, "acquire")
    scene.accept(Leaf.MOTION)
    return scene


def test_a_motor_that_was_only_commanded_may_not_even_brake_after_the_lifetime() -> None:
    assert armed().judged(pwm=0.018, speed_rad_s=-0.5) == {"driven too late"}


def test_a_robot_that_is_free_is_driven_for_a_lifetime_after_who_holds_it() -> None:
    """Without security a free module is anybody's, as seed 821473 found: not only a coordinator's."""
    scene = armed()
    scene.accept(Leaf.LEASE, "release")
    scene.now_ns += LATE_NS
    scene.accept(Leaf.LEASE, "acquire", by="stranger")
    scene.now_ns += LIFETIME_NS // 2
    scene.accept(Leaf.MOTION, by="stranger")
    on = np.zeros((2, SEEN_ROWS, 1))
    on[:, PLANT_PWM] = 0.018
    assert scene.looked(on, scene.now_ns + LIFETIME_NS - 2 * MS) == set()
    # What another than the holder sends prolongs nothing, nor does it after the holder's lifetime.
    scene.now_ns += LIFETIME_NS - MS
    scene.witness.tap(scene.now_ns, "third", "sample", key(ROBOT, SERIAL, Leaf.SETPOINT), b"")
    assert scene.looked(on, scene.now_ns + 5 * MS) == {"driven too late"}


@pytest.mark.parametrize(("leaf", "action"), [(Leaf.MOTION, None), (Leaf.LEASE, "renew")])
def test_a_keep_alive_that_a_stop_has_overtaken_does_not_end_the_stop(leaf: Leaf, action: Any) -> None:
    """On a network that changes the order: the module damps its joint on, as seeds 24 and 2028 found."""
    scene = armed()
    scene.accept(Leaf.STOP)
    scene.accept(leaf, action)
    assert scene.judged(pwm=0.018, speed_rad_s=-0.5) == set()
    assert scene.judged(pwm=0.018, speed_rad_s=+0.5) == {"driven after a stop"}


def test_a_module_that_was_armed_after_a_stop_is_stopped_no_more() -> None:
    scene = armed()
    scene.accept(Leaf.STOP)
    scene.accept(Leaf.LEASE, "acquire")
    assert scene.judged(pwm=0.018, speed_rad_s=-0.5) == {"driven too late"}


@pytest.mark.parametrize("action", ["renew", "release", None])
def test_a_module_accepts_no_command_of_who_does_not_hold_it(action: Any) -> None:
    scene = armed()
    scene.accept(Leaf.MOTION if action is None else Leaf.LEASE, action, by="intruder")
    assert "command of a stranger" in scene.witness.violations
    own = armed()
    own.accept(Leaf.MOTION if action is None else Leaf.LEASE, action)
    assert own.witness.violations == {}


def test_a_module_follows_no_set_point_of_who_does_not_hold_it() -> None:
    scene = armed()
    scene.stream("intruder", 0.3)
    scene.stream(HOLDER, 0.2)
    assert scene.followed(0.2) == set()
    # It holds by chance where the intruder aimed, or shows while it brakes what it followed before.
    assert scene.followed(0.3, "armed") == set()
    # Nor does a row of before the lease, in one message with those of it, tell of it.
    assert scene.followed(0.3, t_ns=1) == set()
    assert scene.followed(0.3) == {"command of a stranger"}


def test_a_copy_of_the_holder_s_set_point_is_the_holder_s() -> None:
    scene = armed()
    scene.stream(HOLDER, 0.2)
    scene.stream("intruder", 0.2)
    assert scene.followed(0.2) == set()


def test_a_module_that_has_accepted_a_stop_brakes_from_two_ticks_after_it() -> None:
    """Long before the lifetime of the command that the stop ended."""
    seen = np.zeros((8, SEEN_ROWS, 1))
    for last, found in ((1, set()), (2, {"driven after a stop"})):
        scene = armed()
        scene.accept(Leaf.STOP)
        seen[: last + 1, PLANT_PWM] = 0.2
        seen[:, PLANT_MOTOR_RAD_S] = 0.5
        assert scene.looked(seen, scene.now_ns) == found


@pytest.mark.parametrize("split", [0, 4])
def test_a_brake_opposes_the_speed_that_the_module_has_read_a_tick_before(split: int) -> None:
    """A spring turns the motor about within a tick, as seed 8 found; in one call or in two."""
    seen = np.zeros((8, SEEN_ROWS, 1))
    seen[:4, PLANT_MOTOR_RAD_S], seen[4:, PLANT_MOTOR_RAD_S] = -0.1, 0.18
    for turns, found in ((4, set()), (5, {"driven after a stop"})):
        scene = armed()
        scene.accept(Leaf.STOP)
        at_ns = scene.now_ns + 10 * MS
        seen[:, PLANT_PWM] = -0.1
        seen[: turns + 1, PLANT_PWM] = 0.1
        for first, end in ((0, split), (split, 8)):
            if end > first:
                scene.looked(seen[first:end], at_ns + first * MS)
        assert set(scene.witness.violations) == found


def test_a_second_stop_gives_no_more_time_to_brake() -> None:
    scene = armed()
    for _ in range(2):
        scene.accept(Leaf.STOP)
    seen = np.zeros((2, SEEN_ROWS, 1))
    seen[:, PLANT_PWM], seen[:, PLANT_MOTOR_RAD_S] = 0.2, 0.5
    assert scene.looked(seen, scene.now_ns) == {"driven after a stop"}


@pytest.mark.parametrize(
    ("pwm", "speed_rad_s", "kinds"),
    [
        (-0.25, 0.5, set()),
        # Slower than the speed's own noise on a spring there is no direction to oppose.
        (0.25, 0.04, set()),
        # Before a limit of its position a fast joint is braked harder; 1.466 rad/s are an X5-9's most.
        (-0.8, 1.2, set()),
        (-0.8, 0.5, {"driven after a stop"}),
        (0.2, 1.2, {"driven after a stop"}),
        (0.5, 0.0, {"driven after a stop"}),
    ],
)
def test_a_stopped_motor_is_off_or_opposes_its_motion(
    pwm: float, speed_rad_s: float, kinds: set[str]
) -> None:
    scene = armed()
    scene.accept(Leaf.STOP)
    seen = np.zeros((4, SEEN_ROWS, 1))
    seen[:, PLANT_PWM], seen[:, PLANT_MOTOR_RAD_S] = pwm, speed_rad_s
    assert scene.looked(seen, scene.now_ns + 10 * MS) == kinds


@pytest.mark.parametrize(
    ("row", "value", "kind"),
    [
        (PLANT_PWM, 0.3, "driven too late"),
        (ASKED, -1.2, "PWM out of range"),
        (ASKED, np.nan, "PWM out of range"),
    ],
)
def test_one_tick_among_many_is_seen(row: int, value: float, kind: str) -> None:
    seen = np.zeros((64, SEEN_ROWS, 1))
    seen[40:48, row] = value
    scene = armed()
    assert scene.looked(seen, scene.now_ns + LATE_NS) == {kind}
    assert scene.looked(np.zeros_like(seen), scene.now_ns + LATE_NS) == {kind}


@pytest.mark.parametrize(("configured", "kinds"), [({}, set()), ({SERIAL: 1.2}, {"speed beyond the limit"})])
def test_no_motor_is_faster_than_its_module_is_configured_to(
    configured: dict[str, float], kinds: set[str]
) -> None:
    """One that is off, or brakes, may be turned by a load."""
    seen = np.zeros((64, SEEN_ROWS, 1))
    seen[40:48, PLANT_MOTOR_RAD_S] = -1.6
    for pwm, found in ((0.0, set()), (0.3, set()), (-0.3, kinds)):
        scene = armed(configured)
        seen[40:48, [PLANT_PWM, ASKED]] = pwm
        assert scene.looked(seen, scene.now_ns) == found


def test_a_motor_may_be_driven_until_two_ticks_after_the_lifetime() -> None:
    """In a run of ticks that begins before that and ends after it."""
    seen = np.zeros((64, SEEN_ROWS, 1))
    for last, found in ((42, set()), (43, {"driven too late"})):
        seen[: last + 1, PLANT_PWM] = 0.3
        scene = armed()
        assert scene.looked(seen, scene.now_ns + LIFETIME_NS - 40 * MS) == found


def outside(pwm: float, speed_rad_s: float, from_rad: float, ticks: int = 64) -> np.ndarray:
    """Ticks of a joint that begins at a position and moves with a speed, its motor driven."""
    seen = np.zeros((ticks, SEEN_ROWS, 1))
    seen[:, Q_RAD, 0] = from_rad + 1e-3 * speed_rad_s * np.arange(ticks)
    seen[:, QD_RAD_S], seen[:, PLANT_PWM], seen[:, ASKED] = speed_rad_s, pwm, pwm
    return seen


@pytest.mark.parametrize(
    ("seen", "kinds"),
    [
        # A load carries it on, its motor off or braking; it is led back; or it is driven within its range.
        (outside(0.0, 2.0, 0.6), set()),
        (outside(-0.3, 2.0, 0.6), set()),
        (outside(-0.3, -2.0, 0.7), set()),
        (outside(0.3, -2.0, 0.7), set()),
        (outside(0.3, 2.0, 0.3), set()),
        (outside(0.3, 2.0, 0.6), {"driven beyond its range"}),
        (outside(-0.3, -2.0, -1.1), {"driven beyond its range"}),
        # From within: of 126 mrad 26 are beyond the limit, or 16.
        (outside(0.3, 2.0, 0.4), {"driven beyond its range"}),
        (outside(0.3, 2.0, 0.39), set()),
    ],
)
def test_no_motor_pushes_its_joint_on_beyond_its_range(seen: np.ndarray, kinds: set[str]) -> None:
    scene = armed()
    assert scene.looked(seen, scene.now_ns) == kinds


def test_the_way_beyond_a_range_counts_from_call_to_call_and_begins_anew_within() -> None:
    scene = armed()
    for _ in range(3):
        assert scene.looked(outside(0.3, 1.0, 0.6, ticks=16), scene.now_ns) == set()
        assert scene.looked(outside(0.0, 0.0, 0.4, ticks=1), scene.now_ns) == set()
    assert scene.looked(outside(0.3, 1.0, 0.6, ticks=16), scene.now_ns) == set()
    assert scene.looked(outside(0.3, 1.0, 0.616, ticks=16), scene.now_ns) == {"driven beyond its range"}


def test_no_motor_is_driven_for_longer_than_a_lifetime_while_its_winding_is_too_hot() -> None:
    """Off for one tick, or cooler, and it begins anew; 154 degrees are the limit, and 157 are seen."""
    seen = np.zeros((84, SEEN_ROWS, 1))
    seen[:, PLANT_PWM], seen[:, ASKED] = 0.3, 0.3
    off = np.zeros((1, SEEN_ROWS, 1))
    hot, warm = armed(), armed()
    hot.winding_c, warm.winding_c = 158.0, 156.0
    for scene in (hot, warm):
        for ticks in (seen, seen, seen, off, seen, seen, seen):
            assert scene.looked(ticks, scene.now_ns) == set()
    assert hot.looked(seen[:1], hot.now_ns) == {"driven too hot"}
    assert warm.looked(seen[:1], warm.now_ns) == set()


@pytest.mark.parametrize("seed", range(40))
def test_a_look_at_all_ticks_at_once_passes_nothing_that_the_checks_would_find(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Values about their limits, some not a number, in several calls: the same with and without it."""
    rng = np.random.default_rng(seed)
    calls = []
    for _ in range(12):
        seen = np.zeros((int(rng.integers(1, 40)), SEEN_ROWS, 1))
        driven = bool(rng.random() < 0.3)
        seen[:, Q_RAD] = rng.uniform(-1.1, 0.6) if driven else rng.uniform(-0.9, 0.4)
        seen[:, QD_RAD_S] = rng.uniform(-3.0, 3.0)
        seen[:, PLANT_MOTOR_RAD_S] = rng.uniform(0.0, 1.9 if driven else 1.0)
        seen[:, PLANT_PWM] = seen[:, ASKED] = rng.uniform(-1.0, 1.0)
        if rng.random() < 0.1:
            seen[-1, rng.choice([ASKED, PLANT_MOTOR_RAD_S, Q_RAD])] = rng.choice([np.nan, 1.01, -20.0])
        calls.append(seen)
    quick, thorough = armed(), armed()
    with monkeypatch.context() as patch:
        nothing_usual = _Usual(np.zeros((3, 1)), np.full((3, 1), -1.0))
        patch.setattr(thorough.witness, "_usual", nothing_usual)
        found = [(quick.looked(seen, quick.now_ns), thorough.looked(seen, quick.now_ns)) for seen in calls]
    assert all(by_quick == by_thorough for by_quick, by_thorough in found)
    assert quick.witness.violations == thorough.witness.violations
