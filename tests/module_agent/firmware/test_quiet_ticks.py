"""Quiet ticks in machine code and ticks of the Python objects are the same ticks, to the bit."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.control import controller
from module_agent.control.gains import default_gains
from module_agent.control.safety import UNCONFIGURED, Safety
from module_agent.firmware import tick_kernel
from module_agent.firmware.config import config_of
from module_agent.hardware import motor_guard
from module_agent.hardware.hardware import LimitState, ModuleSample, SensorSample, WiredModule
from module_agent.hardware.loop_inside import LoopInside
from module_agent.host import AgentHost, InlineWorker
from module_agent.model.catalogue import module_type
from module_agent.transport.transport import Event, Request, Sample
from module_agent.wire.codec import encode
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import (
    Ask,
    ConstantMotion,
    DynamicPattern,
    GainsCommand,
    GoTo,
    LeaseRequest,
    MotionCommand,
    Rest,
    Setpoint,
    Stop,
    WindowedSine,
)

ROBOT, MS = "arm", 1_000_000
TYPES = ("X5-1", "X5-4", "X5-9")
SERIALS = ("A", "B", "C")
BOOT = 7


class Scripted:
    """Wires to three modules that read what the test says."""

    def __init__(self, types: Sequence[str] = TYPES) -> None:
        self.modules = tuple(
            WiredModule(serial, kind, MS, 4 * MS) for serial, kind in zip(SERIALS, types, strict=True)
        )
        self.samples: list[SensorSample] = []
        self.pwm: list[list[float]] = []

    def exchange(self, pwm: Sequence[float]) -> Sequence[SensorSample]:
        self.pwm.append(list(pwm))
        return self.samples

    def close(self) -> None:
        pass


class Plain:
    """The same modules, of which a host does not know that their quiet ticks are compiled."""

    def __init__(self, loops: LoopInside):
        self._loops = loops

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loops, name)


class Handle:
    def undeclare(self) -> None:
        pass


class Network:
    """A transport that keeps what is published and answered."""

    def __init__(self) -> None:
        self.sinks: dict[str, Callable[[Event], None]] = {}
        self.sent: list[tuple[str, bytes]] = []

    def publish(self, at: str, payload: bytes) -> None:
        self.sent.append((at, payload))

    def _declare(self, at: str, sink: Callable[[Event], None]) -> Handle:
        self.sinks[at] = sink
        return Handle()

    serve = subscribe = _declare

    def declare_alive(self, at: str) -> Handle:
        return Handle()

    def close(self) -> None:
        pass

    def tell(self, serial: str, leaf: Leaf, payload: bytes) -> None:
        at = key(ROBOT, serial, leaf)
        if leaf is Leaf.SETPOINT:
            self.sinks[at](Sample(at, payload))
        else:
            self.sinks[at](Request(at, payload, lambda answer: self.sent.append((at + " answer", answer))))


class Agent:
    """One agent process of three modules, whose quiet ticks are compiled or not."""

    def __init__(
        self,
        is_compiled: bool,
        strategy: int,
        expiry: str,
        rate_hz: float,
        safety: Sequence[Safety] = (UNCONFIGURED,) * 3,
        types: Sequence[str] = TYPES,
    ):
        self.types = types
        self.wires, self.network = Scripted(types), Network()
        self.loops = loops = LoopInside(self.wires, dict(zip(SERIALS, safety, strict=True)))
        # What limits the motors' PWM, tick by tick: a status tells all that did since the last.
        self.limits: list[list[int]] = []
        modules: Any = loops if is_compiled else Plain(loops)
        configs = [
            config_of(
                one,
                BOOT,
                strategy=strategy,
                expiry_action=expiry,
                feedback_rate_hz=rate_hz,
                lifetime_ns=40 * MS,
            )
            for one in loops.information
        ]
        self.host = AgentHost(ROBOT, modules, self.network, configs, InlineWorker())

    def tick(self, samples: list[SensorSample]) -> None:
        self.wires.samples = samples
        self.host.cycle()
        quiet = self.host._quiet
        if quiet is None:
            self.limits.append([int(self.loops.quiet_state(k).limit) for k in range(3)])
        else:
            self.limits.append(quiet._integers[:, tick_kernel.LIMIT].tolist())

    @property
    def everything(self) -> tuple[Any, ...]:
        """What can be seen of the agent from outside, and the state of its firmwares."""
        if self.host._quiet is not None:
            self.host._quiet.keep_held(range(len(self.host.modules)))
        states = [module.firmware.state for module in self.host.modules]
        rows = [
            module.firmware.history.block(0, module.firmware.history.next_row) for module in self.host.modules
        ]
        return self.wires.pwm, self.network.sent, states, rows


def first_difference(agents: Sequence[Agent]) -> str:
    """Return where two agents differ first, and how; "" where they are equal.

    They are compared as text, in which NaN is equal to NaN and 0.0 is not -0.0. The text is so long that to
    compare it whole, line by line, would take a failing test minutes.
    """
    for name, *both in zip(
        ("PWM", "messages", "states", "rows", "limits"),
        *((*agent.everything, agent.limits) for agent in agents),
        strict=True,
    ):
        one, other = map(repr, both)
        if one != other:
            at = next((k for k, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), -1)
            return f"{name}: {one[max(0, at - 40) : at + 40]} and {other[max(0, at - 40) : at + 40]}"
    return ""


LOOP = st.fixed_dictionaries(
    {
        "kp": st.floats(0.1, 5.0),
        "ki": st.sampled_from([0.0, 3.0]),
        "kd": st.sampled_from([0.0, 0.02]),
        "feed_forward": st.sampled_from([0.0, 1.0]),
        "dead_zone": st.sampled_from([0.0, 0.01]),
        "i_clamp": st.sampled_from([0.01, 0.25]),
        "punch": st.sampled_from([0.0, 0.02]),
        "target_lowpass": st.sampled_from([1.0, 0.3]),
        "output_lowpass": st.sampled_from([1.0, 0.5]),
        "d_on_error": st.booleans(),
    }
)
ACTIONS = st.one_of(
    st.tuples(st.just("ticks"), st.integers(1, 60)),
    st.tuples(st.just("acquire"), st.integers(0, 2)),
    st.tuples(st.just("renew"), st.integers(0, 2)),
    st.tuples(st.just("release"), st.integers(0, 2)),
    st.tuples(st.just("stop"), st.integers(0, 2)),
    st.tuples(st.just("ask"), st.integers(0, 2)),
    st.tuples(
        st.just("motion"),
        st.integers(0, 2),
        st.sampled_from(
            [
                Rest(duration_s=0.02),
                GoTo(target_rad=0.2, max_speed_rad_s=1.0),
                ConstantMotion(velocity_rad_s=0.4, duration_s=0.05, ramp_s=0.01),
                WindowedSine(amplitude=0.1, frequency_hz=8.0, centre_s=0.06, sigma_s=0.02),
                DynamicPattern(amplitude_rad=0.1, half_width_s=0.02, sigma_s=0.01, repeats=2),
            ]
        ),
    ),
    st.tuples(
        st.just("aim"),
        st.integers(0, 2),
        st.tuples(
            *(st.one_of(st.none(), st.floats(-0.5, 0.5)),) * 2, st.one_of(st.none(), st.floats(-2.0, 2.0))
        ),
    ),
    st.tuples(st.just("gains"), st.integers(0, 2), st.integers(0, 4), st.tuples(LOOP, LOOP, LOOP)),
    st.tuples(
        st.just("sick"),
        st.integers(0, 2),
        st.sampled_from(
            ["position_rad", "velocity_rad_s", "effort_nm", "accel_x_m_s2", "winding_temperature_c"]
        ),
        st.sampled_from([float("nan"), float("inf"), 1e7]),
        st.integers(1, 9),
    ),
    st.tuples(
        # The IMU's time lies ahead of the tick's, or goes back.
        st.just("sick"),
        st.integers(0, 2),
        st.just("imu_t_ns"),
        st.sampled_from([1, 2**62, -1, -10 * MS]),
        st.integers(1, 9),
    ),
    st.tuples(st.just("blind"), st.integers(0, 2)),
    st.tuples(st.just("hot"), st.integers(0, 2), st.floats(100.0, 160.0)),
    st.tuples(st.just("fast"), st.integers(0, 2), st.floats(-2.0, 2.0)),
    st.tuples(st.just("voltage"), st.integers(0, 2), st.sampled_from([-24.0, 0.0, 12.0, 24.0, 48.0, 90.0])),
    st.tuples(st.just("rate"), st.integers(0, 2), st.sampled_from([0.0, 1e-3, 0.4, 1.0])),
    st.tuples(st.just("clock"), st.integers(0, 2), st.sampled_from([-700, -1, 3, 130, 300])),
)

SIDES = st.sampled_from(["disabled", "motor_off", "hold", "spring"])
# The joint walks some 0.01 to 0.1 rad: limits about where it is, and those that are too narrow for it.
LIMITS = st.one_of(
    st.just(UNCONFIGURED),
    st.builds(
        Safety,
        position_rad=st.tuples(
            st.sampled_from([-math.inf, -0.5, -0.02]), st.sampled_from([math.inf, 0.4, 0.01])
        ),
        at_limit=st.tuples(SIDES, SIDES),
        velocity_rad_s=st.sampled_from([math.inf, 0.5, 0.05]),
        effort_nm=st.sampled_from([math.inf, 2.0, 0.2]),
        current_a=st.sampled_from([math.inf, 0.1]),
        winding_c=st.sampled_from([154.0, 90.0]),
    ),
)


class Life:
    """The same random life of two agents."""

    def __init__(self, agents: Sequence[Agent], seed: int, jitter_ns: int = 20):
        self._agents, self._jitter_ns = agents, jitter_ns
        self._rng = np.random.default_rng(seed)
        self._now = [10**12 + 17 * k for k in range(3)]
        self._imu = [0, 0, 0]
        self._tick = 0
        self._q = np.zeros(3)
        self._winding, self._voltage = [40.0] * 3, [24.0] * 3
        self._fast = [0.0] * 3
        # How fast the modules' clocks run.
        self._rate = [1.0] * 3
        self._sick: dict[int, tuple[str, float, int]] = {}
        # Modules whose IMUs have no new samples.
        self._blind: set[int] = set()
        self._seq = self._motions = 0

    def move(self, q_rad: float, share: float) -> None:
        """Put all joints somewhere, and let their motors run at a share of their types' speeds."""
        self._q[:] = q_rad
        for k, name in enumerate(self._agents[0].types):
            kind = module_type(name)
            self._fast[k] = share * kind.gear_ratio * kind.max_speed_rad_s

    def ticks(self, count: int) -> None:
        for _ in range(count):
            self._tick += 1
            self._q += self._rng.normal(0.0, 0.002, 3)
            samples = [self._sample(k) for k in range(3)]
            for agent in self._agents:
                agent.tick(samples)

    def _sample(self, k: int) -> SensorSample:
        jitter_ns = int(self._rng.integers(-self._jitter_ns, self._jitter_ns)) if self._jitter_ns else 0
        self._now[k] += int(self._rate[k] * (MS + jitter_ns))
        if self._tick % 4 == k and k not in self._blind:
            self._imu[k] = self._now[k]
        random = self._rng.normal(0.0, 0.3, 12).tolist()
        values = dict(
            zip(
                SensorSample._fields,
                (
                    *(self._now[k], self._imu[k], float(self._q[k]), *random[:5]),
                    *(self._winding[k], self._voltage[k], *random[5:]),
                ),
                strict=True,
            )
        )
        values["motor_velocity_rad_s"] += self._fast[k]
        name, value, left = self._sick.get(k, ("", 0.0, 0))
        if left:
            # A time that is wrong is so by an amount.
            values[name] = (self._now if value > 0 else self._imu)[k] + value if name == "imu_t_ns" else value
            self._sick[k] = name, value, left - 1
        return SensorSample(**values)  # type: ignore[arg-type]

    def act(self, action: tuple[Any, ...]) -> None:
        what, *rest = action
        if what == "ticks":
            self.ticks(rest[0])
            return
        k = rest[0]
        if what == "sick":
            self._sick[k] = rest[1], rest[2], rest[3]
        elif what == "hot":
            self._winding[k] = rest[1]
        elif what == "voltage":
            self._voltage[k] = rest[1]
        elif what == "fast":
            # The motor runs at a share of its type's speed.
            kind = module_type(self._agents[0].types[k])
            self._fast[k] = rest[1] * kind.gear_ratio * kind.max_speed_rad_s
        elif what == "clock":
            self._now[k] += rest[1] * MS
        elif what == "rate":
            self._rate[k] = rest[1]
        elif what == "blind":
            self._blind ^= {k}
        else:
            self._tell(k, what, *rest[1:])
        self.ticks(1)

    def _tell(self, k: int, what: str, *rest: Any) -> None:
        self._seq += 1
        module = self._agents[0].host.modules[k].firmware
        head: dict[str, Any] = {"serial": SERIALS[k], "boot": BOOT, "seq": self._seq, "sender": "me"}
        command = {**head, "token": module.lease.token, "echo_ns": max(0, self._now[k])}
        if what in ("acquire", "renew", "release"):
            leaf, message = Leaf.LEASE, LeaseRequest(**command, action=what, duration_ns=90 * MS)
        elif what == "stop":
            leaf, message = Leaf.STOP, Stop(**head, why="test")  # type: ignore[assignment]
        elif what == "ask":
            leaf, message = Leaf.STATUS, Ask(**head)  # type: ignore[assignment]
        elif what == "motion":
            self._motions += 1
            message = MotionCommand(**command, motion_id=self._motions, pattern=rest[0])  # type: ignore[assignment]
            leaf = Leaf.MOTION
        elif what == "aim":
            aims = dict(zip(("position_rad", "velocity_rad_s", "effort_nm"), rest[0], strict=True))
            leaf, message = Leaf.SETPOINT, Setpoint(**command, **aims)  # type: ignore[assignment]
        else:
            gains = default_gains(module_type(self._agents[0].types[k]), rest[0])
            names = ("position", "velocity", "effort")
            loops = {
                name: getattr(gains, name).model_copy(update=changes)
                for name, changes in zip(names, rest[1], strict=True)
            }
            leaf = Leaf.GAINS
            message = GainsCommand(**command, gains=gains.model_copy(update=loops))  # type: ignore[assignment]
        for agent in self._agents:
            agent.network.tell(SERIALS[k], leaf, encode(message))


def live(agents: Sequence[Agent], seed: int, actions: Sequence[tuple[Any, ...]]) -> None:
    """Let all modules of some agents be acquired, and then what is to happen, happen."""
    life = Life(agents, seed)
    life.ticks(3)
    for action in (*(("acquire", k) for k in range(3)), *actions):
        life.act(action)


STEPS: list[tuple[Any, ...]] = [
    ("aim", 0, (0.3, None, None)),
    ("motion", 1, WindowedSine(amplitude=0.1, frequency_hz=8.0, centre_s=0.06, sigma_s=0.02)),
    ("aim", 2, (None, 0.2, 0.5)),
    ("ticks", 30),
    *(("renew", k) for k in range(3)),
    ("gains", 0, 2, ({"ki": 3.0, "kd": 0.02}, {"punch": 0.02}, {"target_lowpass": 0.3})),
    ("ticks", 30),
    ("sick", 0, "effort_nm", float("nan"), 3),
    ("hot", 2, 153.0),
    ("fast", 0, 1.3),
    ("fast", 2, -1.3),
    ("ticks", 20),
    ("stop", 1),
    ("sick", 0, "velocity_rad_s", float("inf"), 9),
    ("ticks", 60),
    ("clock", 2, -700),
    *(("acquire", k) for k in range(3)),
    ("ticks", 20),
    ("clock", 0, 130),
    ("ticks", 3),
    ("acquire", 0),
    ("ask", 0),
    ("ticks", 500),
]


@pytest.mark.parametrize("expiry", ["motor_off", "hold", "damping"])
def test_a_life_in_which_everything_happens_is_the_same_in_both(expiry: str) -> None:
    """As the random lives below, in one that is always the same and takes little time."""
    safety = (
        Safety(position_rad=(-0.5, 0.02), at_limit=("hold", "spring"), current_a=0.1),
        Safety(position_rad=(-0.05, 0.4), at_limit="motor_off", effort_nm=0.2),
        UNCONFIGURED,
    )
    agents = [Agent(is_compiled, 3, expiry, 250.0, safety) for is_compiled in (True, False)]
    live(agents, 3, STEPS)
    assert first_difference(agents) == ""


SLOW_CLOCKS: list[tuple[Any, ...]] = [
    ("ticks", 30),
    ("rate", 0, 1e-3),
    ("rate", 1, 0.4),
    ("rate", 2, 0.0),
    *(("renew", k) for k in range(3)),
    ("ticks", 600),
    *(("acquire", k) for k in range(3)),
    ("ticks", 600),
    *(("rate", k, 1.0) for k in range(3)),
    ("ticks", 600),
    *(("acquire", k) for k in range(3)),
    ("ticks", 30),
]


@pytest.mark.parametrize("expiry", ["motor_off", "hold", "damping"])
def test_clocks_that_stand_or_run_too_slowly_are_found_in_the_same_tick_by_both(expiry: str) -> None:
    agents = [Agent(is_compiled, 3, expiry, 250.0) for is_compiled in (True, False)]
    life, states = Life(agents, 4), []
    life.ticks(3)
    for k in range(3):
        life.act(("acquire", k))
    for action in SLOW_CLOCKS:
        life.act(action)
        states.append([module.firmware.state for module in agents[0].host.modules])
    assert states[12] == ["fault", "fault", "fault"]
    assert states[-1] == ["armed", "armed", "armed"]
    assert first_difference(agents) == ""


SWING = WindowedSine(amplitude=0.1, frequency_hz=8.0, centre_s=0.06, sigma_s=0.02)
HOT_SWING: list[tuple[Any, ...]] = [
    ("motion", 0, SWING),
    ("motion", 1, SWING),
    ("aim", 2, (0.1, None, None)),
    ("ticks", 30),
    *(("renew", k) for k in (0, 1)),
    ("ticks", 10),
    ("stop", 1),
    ("hot", 0, 100.0),
    ("ticks", 60),
    ("hot", 0, 50.0),
    ("ticks", 20),
    *(("acquire", k) for k in range(3)),
    ("ticks", 20),
    ("motion", 1, SWING),
    ("ticks", 120),
]


@pytest.mark.parametrize("expiry", ["motor_off", "hold", "damping"])
def test_a_motion_that_is_stopped_expires_or_overheats_is_the_same_in_both(expiry: str) -> None:
    """A stopped motor brakes, an expired one does what is configured, one at its own limit of heat is off."""
    safety = (Safety(winding_c=90.0), UNCONFIGURED, UNCONFIGURED)
    agents = [Agent(is_compiled, 3, expiry, 250.0, safety) for is_compiled in (True, False)]
    life, states = Life(agents, 5), set()
    life.ticks(3)
    for k in range(3):
        life.act(("acquire", k))
    for action in HOT_SWING:
        life.act(action)
        states |= {(module.serial, module.firmware.state) for module in agents[0].host.modules}
    assert {("A", "moving"), ("A", "fault"), ("B", "moving"), ("B", "stopped"), ("C", "expired")} <= states
    assert first_difference(agents) == ""


@pytest.mark.parametrize("expiry", ["motor_off", "hold", "damping"])
@pytest.mark.parametrize("steps", [STEPS, SLOW_CLOCKS, HOT_SWING], ids=["all", "slow clocks", "heat"])
def test_a_time_that_is_met_to_the_nanosecond_is_over_in_both(
    steps: Sequence[tuple[Any, ...]], expiry: str
) -> None:
    """Of clocks without jitter lifetimes, motions and leases end just when a tick begins."""
    agents = [Agent(is_compiled, 3, expiry, 250.0) for is_compiled in (True, False)]
    life = Life(agents, 16, jitter_ns=0)
    life.ticks(3)
    rest = (("acquire", 0), ("motion", 0, Rest(duration_s=0.02)), ("ticks", 60))
    # A row is not held back for an IMU for longer than its period.
    blind = tuple(("blind", k) for k in range(3))
    states = set()
    for action in (*(("acquire", k) for k in range(3)), *steps, *rest, *blind, ("ticks", 300)):
        life.act(action)
        states |= {module.firmware.state for module in agents[0].host.modules}
    assert {"idle", "armed"} < states
    assert first_difference(agents) == ""


@pytest.mark.parametrize("voltage_v", [24.0, 90.0])
@pytest.mark.parametrize("at_limit", ["hold", "spring", "motor_off"])
def test_a_motor_is_bounded_alike_at_every_speed_and_distance_from_a_limit(
    at_limit: Any, voltage_v: float
) -> None:
    """The speed that a limit allows falls with the distance, first by braking, then in proportion to it."""
    safety = (
        Safety(position_rad=(-0.5, 0.5), at_limit=at_limit),
        Safety(position_rad=(-0.5, 0.5), at_limit=at_limit, effort_nm=0.2, braking_rad_s2=2.0),
        Safety(velocity_rad_s=0.5, current_a=0.1),
    )
    agents = [Agent(is_compiled, 3, "hold", 250.0, safety) for is_compiled in (True, False)]
    life = Life(agents, 6)
    life.ticks(3)
    stiff = {"kp": 5.0, "ki": 0.0}
    for k in range(3):
        life.act(("acquire", k))
        life.act(("gains", k, 3, (stiff, {}, {})))
        # 90 V would give what a limit asks for beyond a PWM of 1, which is the largest one all the same.
        life.act(("voltage", k, voltage_v))
    for q_rad in (-0.52, -0.49, -0.45, -0.3, -0.1, 0.1, 0.3, 0.45, 0.49, 0.52):
        for aim_rad in (q_rad - 0.4, q_rad + 0.4):
            for k in range(3):
                life.act(("acquire", k))
                life.act(("aim", k, (aim_rad, None, None)))
            for share in (-1.5, *np.linspace(-0.5, 0.5, 21).tolist(), 1.5):
                life.move(q_rad, share)
                life.ticks(1)
            assert first_difference(agents) == "", (q_rad, aim_rad)


@pytest.mark.parametrize("at_limit", ["hold", "spring"])
def test_a_motor_that_brakes_is_bounded_alike(at_limit: Any) -> None:
    """It brakes less where that would exceed a torque or the supply, and never drives for a limit's sake."""
    safety = (
        Safety(position_rad=(-0.5, 0.5), at_limit=at_limit),
        Safety(effort_nm=0.2, velocity_rad_s=0.1),
        Safety(position_rad=(-0.5, 0.5), at_limit=at_limit, effort_nm=0.1, current_a=0.1),
    )
    agents = [Agent(is_compiled, 3, "damping", 250.0, safety) for is_compiled in (True, False)]
    life = Life(agents, 11)
    life.ticks(3)
    pushed = 0.0
    for voltage_v in (24.0, 1.0):
        for k in range(3):
            life.act(("voltage", k, voltage_v))
        for q_rad in (-0.6, -0.52, -0.48, 0.0, 0.48, 0.52, 0.6):
            for k in range(3):
                life.act(("stop", k))
            for share in (-1.5, *np.linspace(-0.5, 0.5, 21).tolist(), 1.5):
                life.move(q_rad, share)
                life.ticks(2)
                pushed = max(pushed, abs(agents[0].wires.pwm[-1][0]))
            assert {module.firmware.state for module in agents[0].host.modules} == {"stopped"}
            assert first_difference(agents) == "", (voltage_v, q_rad)
    assert pushed > 0.2


@pytest.mark.parametrize("strategy", range(5))
def test_every_choice_of_targets_is_followed_alike(strategy: int) -> None:
    agents = [Agent(is_compiled, strategy, "hold", 250.0) for is_compiled in (True, False)]
    life = Life(agents, 12)
    life.ticks(3)
    for chosen in itertools.product((None, 0.1), (None, 0.3), (None, -0.2)):
        for k in range(3):
            life.act(("acquire", k))
            life.act(("aim", k, chosen))
        life.ticks(6)
        assert {module.firmware.state for module in agents[0].host.modules} == {"streaming"}
        assert first_difference(agents) == "", chosen


@pytest.mark.parametrize("sensor", [name for name in SensorSample._fields if not name.endswith("_ns")])
def test_a_bad_reading_of_any_sensor_is_found_in_the_same_tick_by_both(sensor: str) -> None:
    """A single one is held over, and several are a fault."""
    agents = [Agent(is_compiled, 3, "hold", 250.0) for is_compiled in (True, False)]
    life = Life(agents, 13)
    life.ticks(3)
    for count in (1, 30):
        for k in range(3):
            life.act(("acquire", k))
            life.act(("aim", k, (0.1, None, None)))
        life.ticks(5)
        for k in range(3):
            life.act(("sick", k, sensor, float("nan"), count))
        life.ticks(5)
        states = {module.firmware.state for module in agents[0].host.modules}
        assert states == ({"streaming"} if count == 1 else {"fault"})
        life.ticks(40)
        assert first_difference(agents) == "", count


@pytest.mark.parametrize("jump_ms", [3, 15, 25, 35, 130])
def test_a_jump_of_a_clock_ends_commands_in_the_same_tick_in_both(jump_ms: int) -> None:
    """More than half a lifetime at once does, even if the command is younger than a lifetime then."""
    agents = [Agent(is_compiled, 3, "hold", 250.0) for is_compiled in (True, False)]
    life = Life(agents, 14)
    life.ticks(3)
    for k in range(3):
        life.act(("acquire", k))
        life.act(("aim", k, (0.1, None, None)))
        life.act(("clock", k, jump_ms))
        state = agents[0].host.modules[k].firmware.state
        assert state == ("streaming" if jump_ms < 20 else "expired")
    life.ticks(10)
    assert first_difference(agents) == ""


@pytest.mark.parametrize("winding_c", [40.0, 152.0, 153.9])
def test_what_heat_and_a_low_supply_leave_of_a_motor_is_the_same_in_both(winding_c: float) -> None:
    """Also where a limit of speed, torque or position bounds it, too: a status names both."""
    safety = (
        Safety(velocity_rad_s=0.05),
        Safety(velocity_rad_s=0.05, effort_nm=0.1),
        Safety(position_rad=(-0.2, 0.2), at_limit="hold"),
    )
    agents = [Agent(is_compiled, 3, "hold", 250.0, safety) for is_compiled in (True, False)]
    life = Life(agents, 9)
    life.ticks(3)
    for k in range(3):
        life.act(("hot", k, winding_c))
    for voltage_v in (-24.0, 0.0, 0.5, 3.0, 24.0, 90.0):
        for k in range(3):
            life.act(("voltage", k, voltage_v))
        for aim_rad in (0.5, -0.5):
            life.move(0.15 * np.sign(aim_rad), 0.0)
            for _ in range(4):
                for k in range(3):
                    life.act(("acquire", k))
                    life.act(("aim", k, (aim_rad, None, 2.0 * np.sign(aim_rad))))
                life.ticks(30)
            assert first_difference(agents) == "", (voltage_v, aim_rad)
    assert {module.firmware.state for module in agents[0].host.modules} <= {"armed", "streaming"}


def test_beyond_its_types_own_range_a_motor_is_off_outwards_in_both() -> None:
    agents = [Agent(is_compiled, 1, "hold", 250.0, types=("SEA-snake",) * 3) for is_compiled in (True, False)]
    life = Life(agents, 7)
    life.ticks(3)
    far = module_type("SEA-snake").range_rad
    assert far is not None
    for q_rad in (far[0] - 0.05, far[0] + 0.05, 0.0, far[1] - 0.05, far[1] + 0.05):
        life.move(q_rad, 0.0)
        # Of strategy 1 the effort that is asked for is the PWM.
        for pwm in (0.3, -0.3, 0.0):
            for k in range(3):
                life.act(("acquire", k))
                life.act(("aim", k, (None, None, pwm)))
            life.move(q_rad, 0.0)
            life.ticks(4)
            outward = abs(q_rad) > far[1] and pwm * q_rad > 0.0
            assert agents[0].wires.pwm[-1] == [0.0 if outward else pytest.approx(pwm, abs=0.1)] * 3
            assert first_difference(agents) == "", (q_rad, pwm)


@pytest.mark.parametrize("loop", range(3))
def test_every_term_of_a_loop_is_the_same_in_both(loop: int) -> None:
    """With errors of either sign, larger and smaller than the dead zone, and without a target."""
    agents = [Agent(is_compiled, 3, "hold", 250.0) for is_compiled in (True, False)]
    life = Life(agents, 8)
    life.ticks(3)
    terms: list[dict[str, Any]] = [
        {"punch": 0.02},
        {"punch": 0.02, "dead_zone": 0.2},
        {"kd": 0.02, "d_on_error": True},
        {"kd": 0.02, "d_on_error": False},
        {"ki": 3.0, "i_clamp": 0.01},
        # Zero is the gain of a term that is left out, and no other number is.
        {"punch": 1.0},
        {"kd": 1.0},
        {"ki": 1.0},
        {"target_lowpass": 0.3, "feed_forward": 1.0},
        {"output_lowpass": 0.5},
        # The aims below are beyond these, and 5 times the error is more than a loop may ask for.
        {"min_target": -0.2, "max_target": 0.1},
        {"kp": 5.0, "min_output": -0.1, "max_output": 0.2},
        {"kp": 5.0, "output_lowpass": 0.5},
    ]
    for changes in terms:
        gains = tuple({"kp": 0.5, **changes} if k == loop else {} for k in range(3))
        # The integral and what the last error was go with the target, and come with the next one.
        for size in (0.4, -0.4, 0.05, None, 0.4):
            aim = tuple(size if k == loop else None for k in range(3))
            for k in range(3):
                life.act(("acquire", k))
                life.act(("gains", k, 3, gains))
                life.act(("aim", k, aim))
            life.ticks(6)
        assert first_difference(agents) == "", changes


@pytest.mark.parametrize("strategy", [1, 3])
def test_loops_that_ask_for_more_than_the_whole_supply_get_all_of_it_in_both(strategy: int) -> None:
    """Several loops may ask for 1.5 together, as may an effort of strategy 1; of 90 V that would be there."""
    safety = (Safety(velocity_rad_s=1e3, current_a=1e3, effort_nm=1e3),) * 3
    agents = [Agent(is_compiled, strategy, "hold", 250.0, safety) for is_compiled in (True, False)]
    life = Life(agents, 10)
    life.ticks(3)
    loops = tuple({"kp": 5.0, "min_output": -most, "max_output": most} for most in (1.0, 0.25, 0.25))
    for k in range(3):
        life.act(("acquire", k))
        life.act(("voltage", k, 90.0))
        life.act(("gains", k, strategy, loops))
    for sign in (1.0, -1.0):
        for k in range(3):
            life.act(("acquire", k))
            life.act(("aim", k, (4.0 * sign, 4.0 * sign, 1.5 * sign)))
        life.ticks(4)
        assert agents[0].wires.pwm[-1] == [sign] * 3
        assert first_difference(agents) == "", sign


@pytest.fixture
def python_ticks(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list that grows by a module's number for every tick that its Python objects run."""
    taken: list[int] = []
    take = LoopInside.take

    def counted(self: LoopInside, index: int, read: SensorSample) -> ModuleSample:
        taken.append(index)
        return take(self, index, read)

    monkeypatch.setattr(LoopInside, "take", counted)
    return taken


def test_most_ticks_are_quiet(python_ticks: list[int]) -> None:
    """An idle module needs its Python objects for its statuses, and for nothing else."""
    agent = Agent(True, 3, "hold", 250.0)
    life = Life([agent], 1)
    life.ticks(3)
    python_ticks.clear()
    life.ticks(2100)
    # Idle, a module has a status every 400 ms.
    assert len(python_ticks) == 3 * 5


@pytest.mark.parametrize("at_limit", ["hold", "spring", "motor_off"])
def test_most_ticks_of_a_motion_within_limits_are_quiet(at_limit: Any, python_ticks: list[int]) -> None:
    """Between two statuses nothing of it needs Python's objects."""
    safety = Safety(position_rad=(-3.0, 3.0), at_limit=at_limit)
    agent = Agent(True, 3, "hold", 250.0, (safety,) * 3)
    life = Life([agent], 15)
    life.ticks(3)
    for k in range(3):
        life.act(("acquire", k))
        life.act(("motion", k, SWING))
    life.ticks(3)
    python_ticks.clear()
    life.ticks(30)
    assert {module.firmware.state for module in agent.host.modules} == {"moving"}
    assert python_ticks == []


def test_a_tick_says_how_many_modules_need_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run of ticks of a bus ends with the first in which some do."""
    counts: list[tuple[int, int]] = []
    tick = tick_kernel.tick

    def counted(*arguments: Any) -> None:
        others, results = tick(*arguments), arguments[-1]
        counts.append((others, int(np.count_nonzero(results == tick_kernel.NOT_QUIET))))

    monkeypatch.setattr(tick_kernel, "tick", counted)
    live([Agent(True, 3, "hold", 250.0)], 3, STEPS)
    assert {told for told, _ in counts} == {0, 1, 2, 3}
    assert all(told == found for told, found in counts)


def test_the_kernels_constants_are_those_of_the_objects() -> None:
    assert tick_kernel.NOMINAL_VOLTAGE_V == controller.NOMINAL_VOLTAGE_V
    for name in (
        *("DAMPING_LIMIT_PWM", "STOP", "OFF", "SPRING"),
        *("APPROACH_PER_S", "RETURN_RAD_S", "RELEASE"),
    ):
        assert getattr(tick_kernel, name) == getattr(motor_guard, name), name
    for flag in (LimitState.NONE, *LimitState):
        assert getattr(tick_kernel, f"LIMIT_{flag.name}") == flag.value
    # The record of a module ends with the fields of its bounds, which are stored in this order.
    bounds = motor_guard.Bounds._fields
    assert tick_kernel.MODULE.names[-len(bounds) :] == bounds
    assert len(SensorSample._fields) == tick_kernel.COLUMNS


def test_where_something_is_to_be_done_the_rows_of_all_ticks_are_there() -> None:
    """Estimates are made of them: those of quiet ticks do not wait for their batch then."""
    agents = [Agent(is_compiled, 3, "hold", 250.0) for is_compiled in (False, True)]
    life = Life(agents, 3)
    for _ in range(30):
        life.ticks(3)
        for agent in agents:
            agent.host._from_others.put(Sample("x5/somebody", b""))
        life.ticks(1)
        plain, compiled = ([m.firmware.history.next_row for m in a.host.modules] for a in agents)
        assert compiled == plain


@settings(max_examples=150, deadline=None)
@given(
    st.lists(ACTIONS, min_size=5, max_size=40),
    st.integers(0, 4),
    st.sampled_from(["motor_off", "hold", "damping"]),
    st.sampled_from([250.0, 400.0, 1000.0]),
    st.integers(0, 2**20),
    st.tuples(LIMITS, LIMITS, LIMITS),
)
def test_compiled_quiet_ticks_and_python_ticks_are_equal_to_the_bit(
    actions: list[tuple[Any, ...]],
    strategy: int,
    expiry: str,
    rate_hz: float,
    seed: int,
    safety: tuple[Safety, Safety, Safety],
) -> None:
    agents = [Agent(is_compiled, strategy, expiry, rate_hz, safety) for is_compiled in (True, False)]
    live(agents, seed, actions)
    assert first_difference(agents) == ""
