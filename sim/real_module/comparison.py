"""Compare a real module's log with the simulated module under the same commands.

The log is of a single module, its housing fixed and its output unloaded or nearly so. Its commands go through
the firmware with factory gains, as set-points from the network do. The simulated module starts at the
recorded position, and at temperatures that are fitted to the recorded ones.
"""

import math
from typing import NamedTuple

import numpy as np

from module_agent.control.controller import NOMINAL_VOLTAGE_V
from module_agent.firmware.config import config_of
from module_agent.firmware.firmware import Answer, Firmware, Incoming
from module_agent.hardware.hardware import SensorSample
from module_agent.hardware.loop_inside import LoopInside
from module_agent.model.catalogue import AMBIENT_C
from module_agent.model.errors import RobotError
from module_agent.model.read_only import read_only
from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Ack, LeaseRequest, Message, Setpoint
from sim.actuator.thermal import heat_flow
from sim.geometry.pose import Array
from sim.imperfections.noise_profile import NoiseProfile
from sim.real_module.real_log import RealLog
from sim.robot.robot_file import Robot, parse_robot
from sim.world.world import TICK_S, World

SERIAL = "X-LOG"
SENDER = "log"
BOOT = 1
# Age of a recorded command at its sample, of the 10 ms between samples. It is not recorded: this is the
# middle. The recorded X5-1 starts from rest on its first command and has reached 2.6 rad/s by its first
# sample, which takes 4 to 6 ms; at 3 to 8 ms the ratios differ by a few hundredths.
COMMAND_AGE_S = 0.005
SIGNALS = ("position_rad", "velocity_rad_s", "pwm", "winding_current_a", "effort_nm", "winding_temperature_c")
SETTLED_S = 0.5
_STEP_S = 0.01


def start_warmth(log: RealLog) -> Array:
    """Return winding, housing and body above the ambient at the log's beginning, (3,) [K], read-only.

    The winding's temperature is recorded. Housing and body are not: they are those from which the module's
    heat capacities cool the winding as recorded, by least squares. The motor's own heat during the log is
    neglected: in a module that is warm from earlier work and idles, it is a few tenths of a kelvin.
    """
    steps = np.rint((log.t_s - log.t_s[0]) / _STEP_S).astype(np.int64)
    # The winding's row of flow^steps, by eigenvalues: heat flows between neighbours only, so they are real.
    decays, modes = np.linalg.eig(heat_flow(_STEP_S))
    shares = (modes[0] * decays ** steps[:, None]) @ np.linalg.inv(modes)
    above = log.winding_temperature_c - AMBIENT_C
    rest, *_ = np.linalg.lstsq(shares[:, 1:], above - shares[:, 0] * above[0])
    return read_only(np.array([above[0], *rest]))


class Simulated(NamedTuple):
    """The simulated module's signals at the log's instants, (k,), read-only; `pwm` as in `RealLog`."""

    position_rad: Array
    velocity_rad_s: Array
    pwm: Array
    winding_current_a: Array
    effort_nm: Array
    winding_temperature_c: Array


class SignalRow(NamedTuple):
    """Difference of one signal, recorded minus simulated: root mean squares in its unit, and their ratio.

    `settled_ratio` leaves out the first half second, in which the module catches up with the command. A ratio
    to nothing (a signal that is zero throughout, a log of less than half a second) is None.
    """

    signal: str
    recorded_rms: float
    difference_rms: float
    ratio: float | None
    settled_ratio: float | None


class CommandRefused(RobotError):
    """The firmware refused a command of the log; the message says which and why."""


def bench_robot(type_name: str, start_rad: float) -> Robot:
    """Return the robot of the comparison: one module on the floor, nothing on its output.

    Raises:
        RobotFileError: unknown module type.
    """
    return parse_robot(
        f'name = "bench"\n[base]\nmount = "floor"\n[[module]]\nserial = "{SERIAL}"\ntype = "{type_name}"\n'
        f'parent = "base"\nstart_rad = {start_rad!r}\n',
        "bench",
    )


def start_position(log: RealLog, command_age_s: float = COMMAND_AGE_S) -> float:
    """Return where the module rested before its first command [rad]: q - v T / 2, accelerated evenly."""
    return float(log.position_rad[0] - 0.5 * command_age_s * log.velocity_rad_s[0])


def simulate(
    log: RealLog,
    type_name: str,
    noise: str | NoiseProfile = "ideal",
    seed: int = 0,
    command_age_s: float = COMMAND_AGE_S,
) -> Simulated:
    """Drive a simulated module with a log's commands and bus voltage and read it at the log's instants.

    Position, velocity, effort and current are interpolated between ticks; the PWM is the one in force.

    Raises:
        CommandRefused: the firmware does not take a command.
        RobotFileError: unknown module type.
        KeyError: unknown noise profile.
    """
    robot = bench_robot(type_name, start_position(log, command_age_s))
    world = World(robot, seed, noise, voltage_v=float(log.voltage_v.mean()))
    world.warm(start_warmth(log)[:, None])
    bench = _Bench(world)
    # One tick for the lease, then the first command.
    first_s = TICK_S + command_age_s - log.t_s[0]
    due = np.rint((log.t_s + first_s - command_age_s) / TICK_S).astype(np.int64)
    ticks = math.ceil((log.t_s[-1] + first_s) / TICK_S) + 2
    rows, number = np.empty((ticks, len(Simulated._fields))), 0
    for tick in range(ticks):
        if number < len(due) and tick >= due[number]:
            bench.command(log, number)
            number += 1
        rows[tick] = bench.tick()
    world.close()
    return _at(rows, log.t_s + first_s)


def compare(log: RealLog, simulated: Simulated) -> list[SignalRow]:
    """Return, signal by signal, the rms of recorded minus simulated over the rms of the recorded."""
    settled = log.t_s >= log.t_s[0] + SETTLED_S
    rows = []
    for signal in SIGNALS:
        recorded: Array = getattr(log, signal)
        difference: Array = recorded - getattr(simulated, signal)
        late = _ratio(difference[settled], recorded[settled])
        whole = _ratio(difference, recorded)
        rows.append(SignalRow(signal, _rms(recorded), _rms(difference), whole, late))
    return rows


class _Bench:
    """One module in a world of its own, commanded by the log."""

    def __init__(self, world: World):
        self._hardware = LoopInside(world)
        self._firmware = Firmware(config_of(self._hardware.information[0], BOOT), self._hardware)
        self._sample_ns = 0
        self._seq = 0
        self._inbox: list[Incoming] = []

    def tick(self) -> tuple[float, ...]:
        """Advance by one tick; return its row of `Simulated`."""
        (sample,) = self._hardware.receive()
        self._sample_ns = sample.sensors.t_ns
        if not self._firmware.lease.token:
            self._send(Leaf.LEASE, self._request("acquire"))
        inbox, self._inbox = self._inbox, []
        (pwm,) = self._hardware.send([self._firmware.step(sample, inbox)])
        for answer in self._firmware.publish(pwm):
            ack = decode(Ack, answer.payload) if isinstance(answer, Answer) else None
            if isinstance(answer, Answer) and ack is not None and not ack.accepted:
                # Line 1 of the file is its header.
                line = answer.request + 2
                raise CommandRefused(f"the command of line {line} is refused: {ack.reason}: {ack.detail}")
        return _row(sample.sensors, pwm)

    def command(self, log: RealLog, number: int) -> None:
        """Send row `number` of the log as a setpoint, and keep the lease."""
        aims = {
            "position_rad": log.position_command_rad[number],
            "velocity_rad_s": log.velocity_command_rad_s[number],
            "effort_nm": log.effort_command_nm[number],
        }
        known = {name: None if math.isnan(value) else float(value) for name, value in aims.items()}
        self._send(Leaf.LEASE, self._request("renew"), number)
        self._send(Leaf.SETPOINT, Setpoint.model_validate({**self._head(), **known}), number)

    def _send(self, leaf: Leaf, message: Message, number: int = 0) -> None:
        self._inbox.append(Incoming(leaf, encode(message), number))

    def _request(self, action: str) -> LeaseRequest:
        return LeaseRequest.model_validate({**self._head(), "action": action})

    def _head(self) -> dict[str, object]:
        self._seq += 1
        return {
            "serial": SERIAL,
            "boot": BOOT,
            "seq": self._seq,
            "sender": SENDER,
            "token": self._firmware.lease.token,
            "echo_ns": self._sample_ns,
        }


def _row(sample: SensorSample, pwm: float) -> tuple[float, ...]:
    duty = min(max(pwm * NOMINAL_VOLTAGE_V / sample.voltage_v, -1.0), 1.0)
    return (
        sample.position_rad,
        sample.velocity_rad_s,
        duty,
        sample.motor_current_a,
        sample.effort_nm,
        sample.winding_temperature_c,
    )


def _at(rows: Array, t_s: Array) -> Simulated:
    ticks_s = np.arange(len(rows)) * TICK_S
    last = np.floor(t_s / TICK_S + 1e-6).astype(np.int64)
    columns = [
        rows[last, i] if name == "pwm" else np.interp(t_s, ticks_s, rows[:, i])
        for i, name in enumerate(Simulated._fields)
    ]
    return Simulated(*(read_only(column) for column in columns))


def _ratio(difference: Array, recorded: Array) -> float | None:
    return _rms(difference) / _rms(recorded) if np.any(recorded) else None


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
