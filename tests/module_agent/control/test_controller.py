"""Strategies 2, 3 and 4 are the published block diagrams: checked against transfer functions by scipy.signal.

The model is built from what the manufacturer says the parameters mean, whole signals at a time: filters by
`lfilter`, dead zone, punch and clamps as element-wise maps. It calls none of the code that it checks.
"""

from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import signal
from scipy.linalg import block_diag

from module_agent.control.controller import Command, Controller
from module_agent.control.gains import catalogue_limits, default_gains
from module_agent.firmware.config import FirmwareConfig
from module_agent.firmware.firmware import Answer, Incoming
from module_agent.hardware.hardware import SensorSample
from module_agent.model.catalogue import CATALOGUE, ModuleType
from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Ack, GainsCommand, GainSet, LeaseRequest, Message, PidGains, Setpoint
from tests.module_agent.wired_firmware import WiredFirmware

Array = NDArray[np.float64]
KIND = CATALOGUE["X5-1"]
DT = 1e-3
STRATEGIES = (2, 3, 4)
SETTLING_TICKS = 10_000
# Sums of at most some ten terms of order one in another order: a few hundred roundings of 1e-16 at worst, and
# the derivative divides a rounded difference by 1 ms.
ROUNDING = 1e-11


# ------------------------------------------------------------------ the model, whole signals at a time


class Signals(NamedTuple):
    """Targets and measurements of the three loops, (k,) each."""

    position_target: Array
    velocity_target: Array
    effort_target: Array
    position: Array
    velocity: Array
    effort: Array


def feed_forward_scales(kind: ModuleType, strategy: int) -> tuple[float, float]:
    """PWM per rad/s (rad/s under strategy 2) and PWM per Nm, at 48 V."""
    motor = kind.motor
    rpm_per_pwm = motor.velocity_constant_rpm_v * 48.0 / kind.gear_ratio
    stall_nm = 48.0 * motor.torque_constant_nm_a / motor.resistance_ohm * kind.gear_ratio * motor.efficiency
    return 1.0 if strategy == 2 else 60.0 / (2.0 * np.pi * rpm_per_pwm), 1.0 / stall_nm


def lowpass(values: Array, a: float) -> Array:
    """x = a v + (1 - a) x_prev, whose past is its first value."""
    return signal.lfilter([a], [1.0, a - 1.0], values, zi=[(1.0 - a) * values[0]])[0]


def pid(g: PidGains, scale: float, target: Array, measured: Array) -> Array:
    """One loop's output from its whole input."""
    target = lowpass(np.clip(target, g.min_target, g.max_target), g.target_lowpass)
    error = target - measured
    error = np.where(np.abs(error) < g.dead_zone, 0.0, error)
    steps = (g.ki * error * DT).tolist()
    integral = list(accumulate(steps, lambda s, x: np.clip(s + x, -g.i_clamp, g.i_clamp), initial=0.0))[1:]
    slope = np.diff(error if g.d_on_error else -measured, prepend=np.nan) / DT
    slope[0] = 0.0
    output = g.kp * error + np.array(integral) + g.kd * slope
    output += g.punch * np.sign(error) + g.feed_forward * scale * target
    return lowpass(np.clip(output, g.min_output, g.max_output), g.output_lowpass)


def pwm(gains: GainSet, s: Signals) -> Array:
    """The PWM from whole signals, after the published sums of the strategies."""
    rate_scale, torque_scale = feed_forward_scales(KIND, gains.strategy)
    p = pid(gains.position, 1.0, s.position_target, s.position)
    v = pid(gains.velocity, rate_scale, s.velocity_target, s.velocity)
    to_effort = {2: p + v, 3: 0.0, 4: p}[gains.strategy]
    t = pid(gains.effort, torque_scale, s.effort_target + to_effort, s.effort)
    return np.clip({2: t, 3: p + v + t, 4: v + t}[gains.strategy], -1.0, 1.0)


def run(gains: GainSet, s: Signals) -> Array:
    """The PWM of the code, tick by tick."""
    controller = Controller(KIND, gains, DT)
    rows = np.column_stack(s).tolist()
    return np.array([controller.update(Command(*row[:3]), *row[3:]) for row in rows])


# ------------------------------------------------------------------ signals and settings


def steps(ticks: int = 800) -> Signals:
    """Steps of all targets and measurements, one after another."""
    k = np.arange(ticks)
    at = [np.where(k >= ticks * i // 7, 1.0, 0.0) for i in range(1, 7)]
    size = (0.2, 0.5, 0.3, 0.15, 0.4, 0.2)
    return Signals(*(a * b for a, b in zip(at, size, strict=True)))


def multi_sines(ticks: int = 1000, size: float = 1.0) -> Signals:
    """Sines of whole periods within 1000 ticks, each input at frequencies of its own."""
    t = np.arange(ticks) * DT
    amplitude = np.array([0.1, 0.3, 0.2, 0.1, 0.3, 0.2]) * size
    base = (1, 2, 3, 4, 5, 6)
    return Signals(
        *(
            a * sum(np.sin(2.0 * np.pi * (b + 7 * n) * t + n * n) for n in range(5)) / 5.0
            for a, b in zip(amplitude, base, strict=True)
        )
    )


FULL = {
    "ki": 3.0,
    "kd": 0.002,
    "feed_forward": 0.7,
    "dead_zone": 0.02,
    "i_clamp": 0.03,
    "punch": 0.05,
    "min_target": -0.15,
    "max_target": 0.12,
    "target_lowpass": 0.3,
    "min_output": -0.6,
    "max_output": 0.5,
    "output_lowpass": 0.6,
}
SETTINGS: dict[str, dict[str, object]] = {
    "factory": {},
    "integrating": {"ki": 5.0, "i_clamp": 1e3},
    "integral clamped": {"ki": 40.0, "i_clamp": 0.05},
    "dead zone and punch": {"dead_zone": 0.03, "punch": 0.1},
    "derivative of the error": {"kd": 0.003, "d_on_error": True},
    "derivative of the measurement": {"kd": 0.003, "d_on_error": False},
    "targets filtered and clamped": {"target_lowpass": 0.1, "min_target": -0.05, "max_target": 0.1},
    "everything": FULL | {"d_on_error": True},
    "everything, derivative of the measurement": FULL | {"d_on_error": False},
}


def gain_set(strategy: int, changes: dict[str, object]) -> GainSet:
    """Factory gains with the same changes in all three loops."""
    return changed(
        default_gains(KIND, strategy), **dict.fromkeys(("position", "velocity", "effort"), changes)
    )


def changed(gains: GainSet, **loops: dict[str, object]) -> GainSet:
    return GainSet.model_validate(
        gains.model_dump() | {name: getattr(gains, name).model_dump() | c for name, c in loops.items()}
    )


# ------------------------------------------------------------------ open loop


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("inputs", [steps, multi_sines])
def test_the_pwm_follows_the_discrete_model_tick_by_tick(
    strategy: int, name: str, inputs: Callable[[], Signals]
) -> None:
    gains, s = gain_set(strategy, SETTINGS[name]), inputs()
    expected = pwm(gains, s)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(run(gains, s), expected, rtol=0.0, atol=ROUNDING)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_large_error_saturates_as_in_the_model(strategy: int) -> None:
    gains, s = gain_set(strategy, FULL | {"min_output": -3.0, "max_output": 3.0}), multi_sines(size=40.0)
    expected = pwm(gains, s)
    assert np.mean(np.abs(expected) == 1.0) > 0.05
    np.testing.assert_allclose(run(gains, s), expected, rtol=0.0, atol=10.0 * ROUNDING)


LOOP = st.fixed_dictionaries(
    {
        "kp": st.floats(0.0, 5.0),
        "ki": st.floats(0.0, 20.0),
        "kd": st.floats(0.0, 0.01),
        "feed_forward": st.floats(-1.0, 1.0),
        "dead_zone": st.floats(0.0, 0.1),
        "i_clamp": st.floats(0.0, 0.3),
        "punch": st.floats(0.0, 0.2),
        "min_target": st.floats(-0.3, -0.01),
        "max_target": st.floats(0.01, 0.3),
        "target_lowpass": st.floats(0.01, 1.0),
        "min_output": st.floats(-1.0, -0.1),
        "max_output": st.floats(0.1, 1.0),
        "output_lowpass": st.floats(0.01, 1.0),
        "d_on_error": st.booleans(),
    }
)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(strategy=st.sampled_from(STRATEGIES), p=LOOP, v=LOOP, t=LOOP)
def test_any_gains_give_the_model_s_pwm(
    strategy: int, p: dict[str, object], v: dict[str, object], t: dict[str, object]
) -> None:
    gains = changed(default_gains(KIND, strategy), position=p, velocity=v, effort=t)
    s = multi_sines(200)
    # Below: an error may be rounded to either side of a dead zone's edge, where punch and P jump. Such gains
    # say nothing here, and are rare: 200 errors, edges 1e-14 wide.
    np.testing.assert_allclose(run(gains, s), pwm(gains, s), rtol=0.0, atol=10.0 * ROUNDING)


# ------------------------------------------------------------------ transfer functions


class Tf(NamedTuple):
    """A transfer function of ascending powers of 1/z."""

    num: Array
    den: Array

    def __mul__(self, other: object) -> "Tf":
        if not isinstance(other, Tf):
            return NotImplemented
        return Tf(np.convolve(self.num, other.num), np.convolve(self.den, other.den))

    def plus(self, other: "Tf") -> "Tf":
        one, two = np.convolve(self.num, other.den), np.convolve(other.num, self.den)
        size = max(len(one), len(two))
        num = np.pad(one, (0, size - len(one))) + np.pad(two, (0, size - len(two)))
        return Tf(num, np.convolve(self.den, other.den))

    def at(self, hz: Array) -> NDArray[np.complex128]:
        return signal.freqz(self.num, self.den, worN=hz, fs=1.0 / DT)[1]

    def state_space(self) -> tuple[Array, Array, Array, Array]:
        size = max(len(self.num), len(self.den))
        padded = [np.pad(c, (0, size - len(c))) for c in self]
        return signal.tf2ss(*padded)


def constant(value: float) -> Tf:
    return Tf(np.array([value]), np.array([1.0]))


ZERO = constant(0.0)


def filter_tf(a: float) -> Tf:
    return Tf(np.array([a]), np.array([1.0, a - 1.0]))


def loop_tfs(g: PidGains, scale: float) -> tuple[Tf, Tf]:
    """From target and from measurement to output, as long as nothing is clamped and no error is dead."""
    derivative = Tf(np.array([g.kd, -g.kd]) / DT, np.array([1.0]))
    core = constant(g.kp)
    if g.ki:
        core = core.plus(Tf(np.array([g.ki * DT]), np.array([1.0, -1.0])))
    on_error = core.plus(derivative) if g.d_on_error else core
    out = filter_tf(g.output_lowpass)
    from_target = out * on_error.plus(constant(g.feed_forward * scale)) * filter_tf(g.target_lowpass)
    # The derivative acts on the negative measurement either way.
    return from_target, constant(-1.0) * out * core.plus(derivative)


def controller_tfs(gains: GainSet) -> list[Tf]:
    """From every field of `Signals`, in order, to the PWM."""
    rate_scale, torque_scale = feed_forward_scales(KIND, gains.strategy)
    p = loop_tfs(gains.position, 1.0)
    v = loop_tfs(gains.velocity, rate_scale)
    t = loop_tfs(gains.effort, torque_scale)
    through_t = constant(1.0)
    p_way = through_t if gains.strategy == 3 else t[0]
    v_way = t[0] if gains.strategy == 2 else through_t
    return [p_way * p[0], v_way * v[0], t[0], p_way * p[1], v_way * v[1], t[1]]


def linear_gains(strategy: int, d_on_error: bool, ki: float = 2.0) -> GainSet:
    """All terms that are linear, in every loop."""
    wide = {"min_output": -50.0, "max_output": 50.0, "min_target": -50.0, "max_target": 50.0, "i_clamp": 50.0}
    gains = changed(default_gains(KIND, strategy), position=wide, velocity=wide, effort=wide)
    return changed(
        gains,
        position={"ki": ki, "kd": 0.004, "target_lowpass": 0.2, "d_on_error": d_on_error},
        velocity={"kd": 2e-5, "target_lowpass": 0.4, "d_on_error": d_on_error},
        effort={"kd": 5e-4, "feed_forward": 0.8, "target_lowpass": 0.5, "d_on_error": d_on_error},
    )


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("d_on_error", [False, True])
@pytest.mark.parametrize("field", Signals._fields)
def test_gain_and_phase_from_every_input_are_those_of_the_transfer_function(
    strategy: int, d_on_error: bool, field: str
) -> None:
    gains = linear_gains(strategy, d_on_error)
    hz = np.array([1, 4, 15, 60, 200, 420])
    t = np.arange(4000) * DT
    # Small enough for the PWM to stay within its limits, though derivatives amplify 420 Hz thousandfold.
    wave = 1e-3 * np.cos(2.0 * np.pi * np.outer(hz, t)).sum(axis=0)
    still = np.zeros_like(t)
    ours = run(gains, Signals(still, *[still] * 5)._replace(**{field: wave}))
    assert np.abs(ours).max() < 1.0
    # One period, the last of four: after 3 s the slowest filter, 0.8 a tick, has forgotten its start.
    spectrum = np.fft.rfft(ours[-1000:])[hz] / np.fft.rfft(wave[-1000:])[hz]
    expected = controller_tfs(gains)[Signals._fields.index(field)].at(hz.astype(float))
    # Rounding of a signal of order 1e-1 against responses of order 1e-3 in a transform of 1000 points.
    np.testing.assert_allclose(spectrum, expected, rtol=1e-8, atol=1e-9)


# ------------------------------------------------------------------ closed loop around a linear plant


class Plant(NamedTuple):
    """Two inertias and a spring, driven by PWM; measures position, velocity and effort at the output."""

    a: Array
    b: Array
    c: Array


def plant() -> Plant:
    """The plant under a PWM held over each tick, exactly discretised.

    A spring to the ground keeps the joint near zero, so that no pole is at z = 1.
    """
    motor, load, spring, loss, ground = 3e-3, 1e-2, 40.0, 0.05, 2.0
    viscous, nm_per_pwm = 0.15, 5.6
    a = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-spring / motor, -(viscous + loss) / motor, spring / motor, loss / motor],
            [0.0, 0.0, 0.0, 1.0],
            [spring / load, loss / load, -(spring + ground) / load, -loss / load],
        ]
    )
    b = np.array([[0.0], [nm_per_pwm / motor], [0.0], [0.0]])
    c = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [spring, 0.0, -spring, 0.0]])
    ad, bd, *_ = signal.cont2discrete((a, b, c, np.zeros((3, 1))), DT, method="zoh")
    return Plant(ad, bd, c)


def closed_loop(gains: GainSet) -> tuple[Array, Array, Array]:
    """A, B, C from the targets to position, velocity, effort; all six transfer functions in parallel."""
    p = plant()
    parts = [tf.state_space() for tf in controller_tfs(gains)]
    ac = block_diag(*(x[0] for x in parts))
    bc = block_diag(*(x[1].reshape(-1, 1) if x[0].size else np.zeros((0, 1)) for x in parts))
    cc = np.hstack([x[2] for x in parts])
    dc = np.hstack([x[3] for x in parts])
    a = np.block(
        [
            [p.a + p.b @ dc[:, 3:] @ p.c, p.b @ cc],
            [bc[:, 3:] @ p.c, ac],
        ]
    )
    b = np.vstack([p.b @ dc[:, :3], bc[:, :3]])
    return a, b, np.hstack([p.c, np.zeros((3, len(ac)))])


def control(
    pwm_of: Callable[[Sequence[float], Sequence[float]], float], targets: Array
) -> tuple[Array, Array]:
    """Run a controller around the plant; return measurements (k, 3) and PWM (k,)."""
    p, x = plant(), np.zeros(4)
    measured, driven = np.empty((len(targets), 3)), np.empty(len(targets))
    for k, target in enumerate(targets.tolist()):
        measured[k] = p.c @ x
        driven[k] = pwm_of(target, measured[k].tolist())
        x = p.a @ x + p.b[:, 0] * driven[k]
    return measured, driven


def of_controller(gains: GainSet) -> Callable[[Sequence[float], Sequence[float]], float]:
    controller = Controller(KIND, gains, DT)
    return lambda target, measured: controller.update(Command(*target), *measured)


class Wired:
    """A module's firmware that gets its gains and one setpoint a tick as messages."""

    def __init__(self, gains: GainSet):
        config = FirmwareConfig("A", KIND, 7, catalogue_limits(KIND), strategy=gains.strategy)
        self._wired = WiredFirmware(config)
        self._now_ns, self._seq = 0, 0
        self._tick((0.0, 0.0, 0.0), [])
        self._tick(
            (0.0, 0.0, 0.0), [(Leaf.LEASE, LeaseRequest, {"action": "acquire", "duration_ns": 10**10})]
        )
        self._gains = gains

    def __call__(self, target: Sequence[float], measured: Sequence[float]) -> float:
        position, velocity, effort = target
        aims = {"position_rad": position, "velocity_rad_s": velocity, "effort_nm": effort}
        messages: list[tuple[Leaf, type[Message], dict[str, object]]] = [(Leaf.SETPOINT, Setpoint, aims)]
        if self._wired.firmware.state == "armed":
            # Gains first: they begin without a past, as the model does.
            messages.insert(0, (Leaf.GAINS, GainsCommand, {"gains": self._gains}))
        return self._tick(measured, messages)

    def _tick(
        self, measured: Sequence[float], messages: list[tuple[Leaf, type[Message], dict[str, object]]]
    ) -> float:
        echo_ns, self._now_ns = self._now_ns, self._now_ns + 1_000_000
        inbox = [
            Incoming(leaf, encode(kind(**self._head(echo_ns), **rest)), 1) for leaf, kind, rest in messages
        ]
        still = (0.0, 0.0, 0.0, 30.0, 24.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.8)
        sample = SensorSample(self._now_ns, self._now_ns, *measured, *still)  # type: ignore[call-arg]
        out, sent = self._wired.tick(sample, inbox)
        answers = [decode(Ack, o.payload) for o in sent if isinstance(o, Answer)]
        assert all(a.accepted for a in answers), answers
        return out

    def _head(self, echo_ns: int) -> dict[str, object]:
        self._seq += 1
        token = self._wired.firmware.lease.token
        return {
            "serial": "A", "boot": 7, "seq": self._seq, "sender": "me", "token": token, "echo_ns": echo_ns,
        }  # fmt: skip


def target_steps(ticks: int) -> Array:
    """A tick of nothing, so that the loops begin at rest, then steps of all three targets in turn."""
    targets = np.zeros((ticks, 3))
    targets[1:, 0] = 0.05
    targets[ticks // 3 :, 1] = 0.1
    targets[2 * ticks // 3 :, 2] = -0.1
    return targets


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("d_on_error", [False, True])
@pytest.mark.parametrize("driver", [of_controller, Wired])
def test_the_closed_loop_s_step_responses_are_the_linear_model_s(
    strategy: int, d_on_error: bool, driver: Callable[[GainSet], Callable[..., float]]
) -> None:
    gains = linear_gains(strategy, d_on_error)
    targets = target_steps(1500)
    a, b, c = closed_loop(gains)
    x, expected = np.zeros(len(a)), np.empty((len(targets), 3))
    for k, target in enumerate(targets):
        expected[k] = c @ x
        x = a @ x + b @ target
    measured, driven = control(driver(gains), targets)
    # Within what 24 V give, or the firmware would limit what the linear model does not.
    assert np.abs(driven).max() < 0.49
    assert np.ptp(measured[:, 0]) > 0.01
    # A stable loop does not let roundings grow; the model's integrals of target and measurement, told apart,
    # reach 0.1 and cost a few digits.
    np.testing.assert_allclose(measured, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("which", [0, 1, 2])
def test_the_closed_loop_s_gain_and_phase_are_the_model_s(strategy: int, which: int) -> None:
    # In PWM per rad s, or Nm per rad s: so that the integral settles within the time below.
    gains = linear_gains(strategy, d_on_error=False, ki=5.0 if strategy == 3 else 50.0)
    hz = np.array([1, 3, 8, 20, 45])
    p = plant()
    from_inputs = np.array([tf.at(hz.astype(float)) for tf in controller_tfs(gains)])
    z = np.exp(2j * np.pi * hz * DT)
    to_outputs = np.array([p.c @ np.linalg.solve(w * np.eye(4) - p.a, p.b)[:, 0] for w in z]).T
    # u = Cr r + Cy y and y = P u.
    expected = to_outputs * from_inputs[which] / (1.0 - np.sum(from_inputs[3:] * to_outputs, axis=0))
    # The parallel model's integrals of target and of measurement are poles at 1 that cancel; all the others
    # have died away, to 1e-8, before the last second.
    poles = np.abs(np.linalg.eigvals(closed_loop(gains)[0]))
    assert np.sum(poles > 1.0 - 1e-6) <= 3
    assert poles[poles < 1.0 - 1e-6].max() ** (SETTLING_TICKS - 1000) < 1e-8
    targets = np.zeros((SETTLING_TICKS, 3))
    t = np.arange(SETTLING_TICKS) * DT
    targets[:, which] = 0.01 * np.sin(2.0 * np.pi * np.outer(hz, t)).sum(axis=0)
    measured, driven = control(of_controller(gains), targets)
    assert np.abs(driven).max() < 1.0
    response = np.fft.rfft(measured[-1000:], axis=0)[hz].T / np.fft.rfft(targets[-1000:, which])[hz]
    np.testing.assert_allclose(response, expected, rtol=1e-6, atol=1e-7)
