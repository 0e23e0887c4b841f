"""Whatever a holder commands, sensors read and clocks do: what a module does not do.

Its PWM is finite and within [-1, 1]; its motor is not driven later than the lifetime and two ticks after the
last accepted command; it has one holder; a stop stops it.
"""

import math
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.control.gains import default_gains
from module_agent.control.safety import UNCONFIGURED, Safety
from module_agent.firmware.firmware import Incoming
from module_agent.firmware.state import COMMANDED
from module_agent.hardware.hardware import SensorSample
from module_agent.hardware.motor_guard import DAMPING_LIMIT_PWM
from module_agent.model.catalogue import CATALOGUE
from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import (
    Ack,
    GainsCommand,
    GainSet,
    GoTo,
    LeaseRequest,
    Message,
    MotionCommand,
    PidGains,
    Setpoint,
    Stop,
    WindowedSine,
)
from module_agent.wire.proof import proven
from tests.module_agent.firmware_bench import BOOT, MS, Bench

LIFETIME_MS = 250
READINGS = [name for name in SensorSample._fields if not name.endswith("t_ns")]
SECRETS = {"a": b"secret of a", "b": b"", "c": b"secret of c"}
SENDERS = st.sampled_from(sorted(SECRETS))

SIZES = st.one_of(
    st.none(),
    st.floats(-2.0, 2.0),
    st.sampled_from([1e4, -1e4, 1e6, -1e6, math.nan, math.inf, -math.inf, 1e300]),
)
GAINS = st.sampled_from([0.0, 1.0, 1e3, -1e3, 1e6, math.nan, math.inf])
LOOP = st.builds(dict, kp=GAINS, ki=GAINS, kd=GAINS, feed_forward=GAINS, max_output=GAINS, punch=GAINS)
PATTERNS = st.sampled_from(
    [
        GoTo(target_rad=0.5, max_speed_rad_s=1.0),
        GoTo(target_rad=1e4, max_speed_rad_s=1e6),
        GoTo(target_rad=-40.0, max_speed_rad_s=14.0),
        WindowedSine(amplitude=0.2),
        WindowedSine(amplitude=1e6, frequency_hz=50.0),
    ]
)
VALUES = st.one_of(
    st.floats(-3.0, 3.0),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e12, 9e3, -9e3, 50.0, 153.0]),
)
ACTIONS = st.one_of(
    st.tuples(st.just("wait"), st.sampled_from([1, 30, 120])),
    st.tuples(st.just("wait"), st.just(LIFETIME_MS + 5)),
    st.tuples(st.just("lease"), SENDERS, st.sampled_from(["acquire", "renew", "release"]), st.booleans()),
    st.tuples(st.just("setpoint"), SENDERS, SIZES, SIZES, SIZES),
    st.tuples(st.just("setpoint"), st.just("a"), st.floats(-1.0, 1.0), st.none(), st.none()),
    st.tuples(st.just("motion"), SENDERS, PATTERNS),
    st.tuples(st.just("gains"), SENDERS, st.integers(0, 4), LOOP, LOOP, LOOP),
    st.tuples(st.just("stop")),
    st.tuples(st.just("sick"), st.dictionaries(st.sampled_from(READINGS), VALUES, max_size=3)),
    st.tuples(st.just("place"), st.floats(-2.0, 2.0)),
    st.tuples(st.just("clock"), st.sampled_from([-4_000, -700, -2, -1])),
    st.tuples(st.just("clock"), st.sampled_from([1, 240, 260, 10_000])),
    st.tuples(st.just("m_stop"), st.booleans()),
    st.tuples(st.just("noise"), st.binary(max_size=64)),
)
SAFETY = st.one_of(
    st.just(UNCONFIGURED),
    st.builds(
        Safety,
        position_rad=st.sampled_from([(-math.inf, math.inf), (-0.5, 0.5), (0.1, math.inf)]),
        at_limit=st.sampled_from(["disabled", "motor_off", "hold", "spring"]),
        velocity_rad_s=st.sampled_from([math.inf, 0.3]),
        effort_nm=st.sampled_from([math.inf, 1.0]),
        m_stop=st.sampled_from([None, "disabled", "motor_off", "hold"]),
    ),
)


class Attacked:
    """A module under attack, and what truly happened: time passes by ticks, not by its clock."""

    def __init__(self, safety: Safety, strategy: int):
        self.bench = Bench(safety=safety, strategy=strategy)
        self.ticks = self.accepted = 0
        self.stopped = False
        self.motions = 0

    def tick(self, *incoming: Incoming) -> list[bytes]:
        self.ticks += 1
        before = self.bench.firmware.lease
        holder, token = before.holder, before.token
        answers = self.bench.tick(*incoming)
        if incoming and incoming[0].leaf is not Leaf.STOP and any(decode(Ack, a).accepted for a in answers):
            self.accepted = self.ticks
        pwm, state = self.bench.pwm, self.bench.firmware.state
        # A NaN is in no range.
        assert -1.0 <= pwm <= 1.0
        if self.ticks - self.accepted > LIFETIME_MS + 2:
            assert state not in COMMANDED
        if state not in COMMANDED:
            assert pwm == 0.0 or state == "stopped"
            # A limit of the type, such as that of the speed, may brake harder, as hard as the motor is fast.
            share = self.share_of_speed
            assert self.is_limited or abs(pwm) <= max(DAMPING_LIMIT_PWM, abs(share))
            assert self.is_limited or pwm * share <= 0.0
        lease = self.bench.firmware.lease
        assert lease.holder in (None, holder) or lease.token == token + 1
        return answers

    @property
    def is_limited(self) -> bool:
        """Whether a configured limit may push a braked joint, such as back into its range."""
        return self.bench.firmware.config.safety != UNCONFIGURED

    @property
    def share_of_speed(self) -> float:
        """The motor's speed as it is read, over that of its type."""
        firmware = self.bench.firmware
        kind, sample = firmware.config.kind, firmware._sample
        assert sample is not None
        return sample.sensors.motor_velocity_rad_s / (kind.gear_ratio * kind.max_speed_rad_s)

    def tell(self, leaf: Leaf, message: Message, secret: bytes = b"") -> bool:
        """Send a message, checked by no model, as an attacker would; return whether it was accepted."""
        acting = self.bench.firmware.lease.holder
        lapsed = self.bench.firmware.lease.lapsed(self.bench.now + MS)
        (answer,) = self.tick(Incoming(leaf, proven(encode(message), secret), 1))
        accepted = decode(Ack, answer).accepted
        sender: str = getattr(message, "sender", "")
        if accepted and leaf is not Leaf.STOP:
            is_acquisition = isinstance(message, LeaseRequest) and message.action == "acquire"
            assert acting == sender or (is_acquisition and (acting is None or lapsed))
            self.stopped = self.stopped and not is_acquisition
        if self.stopped:
            assert self.bench.firmware.state in ("stopped", "fault")
        return accepted

    def act(self, what: str, *rest: Any) -> None:
        bench = self.bench
        head = bench.head(sender=rest[0] if rest and isinstance(rest[0], str) else "x")
        secret = SECRETS.get(head["sender"], b"")
        match what:
            case "wait":
                for _ in range(rest[0]):
                    self.tick()
            case "lease":
                # A thief has the sender's name and token, and not its secret.
                own = SECRETS[rest[0]] if rest[2] else b"stolen"
                self.tell(Leaf.LEASE, LeaseRequest(**head, action=rest[1], secret=own), own)
            case "setpoint":
                values = dict(zip(("position_rad", "velocity_rad_s", "effort_nm"), rest[1:], strict=True))
                self.tell(Leaf.SETPOINT, Setpoint.model_construct(**head, **values), secret)
            case "motion":
                self.motions += 1
                command = MotionCommand(**head, motion_id=self.motions, pattern=rest[1])
                self.tell(Leaf.MOTION, command, secret)
            case "gains":
                factory = default_gains(CATALOGUE["X5-9"], rest[1])
                names = ("position", "velocity", "effort")
                loops = {
                    name: PidGains.model_construct(**{**getattr(factory, name).model_dump(), **changed})
                    for name, changed in zip(names, rest[2:], strict=True)
                }
                gains = GainSet.model_construct(strategy=rest[1], **loops)
                self.tell(Leaf.GAINS, GainsCommand.model_construct(**head, gains=gains), secret)
            case "stop":
                assert self.tell(Leaf.STOP, Stop(serial="A", boot=0, seq=1, sender="any"))
                self.stopped = True
                self.tick()
            case "noise":
                self.tick(*(Incoming(leaf, rest[0], None) for leaf in (Leaf.SETPOINT, Leaf.STOP, Leaf.LEASE)))
            case "sick":
                bench.wrong = rest[0]
            case "place":
                bench.position = rest[0]
            case "clock":
                bench.now = max(0, bench.now + rest[0] * MS)
            case "m_stop":
                bench.m_stop = rest[0]
        self.tick()
        if self.stopped:
            assert bench.firmware.state in ("stopped", "fault")


@settings(max_examples=150, deadline=None)
@given(st.lists(ACTIONS, min_size=5, max_size=40), SAFETY, st.integers(0, 4))
def test_no_sequence_of_attacks_breaks_what_a_module_promises(
    actions: list[tuple[Any, ...]], safety: Safety, strategy: int
) -> None:
    attacked = Attacked(safety, strategy)
    attacked.act("lease", "a", "acquire", True)
    for action in actions:
        attacked.act(*action)
    assert attacked.bench.firmware.config.boot == BOOT


def test_the_attacks_reach_what_they_are_to_try() -> None:
    """A holder moves the motor, a thief does not, and 10,000 rad and gains of 1e6 are refused."""
    attacked = Attacked(UNCONFIGURED, 3)
    attacked.act("lease", "a", "acquire", True)
    attacked.act("setpoint", "a", 0.5, None, None)
    assert attacked.bench.pwm != 0.0
    assert attacked.bench.firmware.state == "streaming"
    refusals = attacked.bench.firmware.admission.refusals
    for action in (
        ("setpoint", "a", 1e4, None, None),
        ("setpoint", "a", None, None, 1e6),
        ("setpoint", "a", math.nan, None, None),
        ("lease", "a", "acquire", False),
        ("lease", "a", "renew", False),
        ("lease", "b", "acquire", True),
        ("gains", "a", 3, {"kp": 1e6}, {}, {}),
        ("motion", "a", GoTo(target_rad=1e4, max_speed_rad_s=1e6)),
    ):
        before = sum(refusals.values())
        attacked.act(*action)
        assert sum(refusals.values()) == before + 1, action
    assert set(refusals) == {"limit", "not_finite", "unproven", "held"}
    attacked.act("wait", LIFETIME_MS + 3)
    assert attacked.bench.firmware.state == "expired"
