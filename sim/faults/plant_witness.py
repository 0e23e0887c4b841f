"""What the motors truly did, tick by tick, against what was commanded.

The witness sees the plant and the bytes on the wire, and neither the firmware's state nor its opinion. But
nothing answers a set-point: which one is followed is what the module's own rows say.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from module_agent.control.safety import UNCONFIGURED
from module_agent.hardware.motor_guard import DAMPING_LIMIT_PWM
from module_agent.model.catalogue import ModuleType, module_type
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode
from module_agent.wire.feedback_rows import STATE_NAMES, unpack
from module_agent.wire.keys import KeyParts, Leaf, parse
from module_agent.wire.messages import Ack, Feedback, GainsCommand, LeaseRequest, MotionCommand, Setpoint
from module_agent.wire.refusal import WireError
from sim.geometry.pose import Array
from sim.virtual_time.loop import NS_PER_S
from sim.virtual_time.quiet_run import ASKED
from sim.virtual_time.robot import VirtualRobot
from sim.world.world import TICK_NS
from sim.world.world_kernel import PLANT_MOTOR_RAD_S, PLANT_PWM, Q_RAD, QD_RAD_S

LIFETIME_NS = 250_000_000
COMMANDS = (Leaf.LEASE, Leaf.MOTION, Leaf.SETPOINT, Leaf.GAINS)
# What asks for an answer to a command.
_REQUESTS: dict[Leaf, type[LeaseRequest] | type[MotionCommand] | type[GainsCommand]] = {
    Leaf.LEASE: LeaseRequest,
    Leaf.MOTION: MotionCommand,
    Leaf.GAINS: GainsCommand,
}
_STREAMING = STATE_NAMES.index("streaming")
# Below this the sign of a speed is that of its noise on a springy joint [rad/s].
SLOW_RAD_S = 0.05
# Of a motor, seen at the output, over the speed of its type or its configuration: loops overshoot their
# clamps. The output swings about that speed on its spring.
SPEED_MARGIN = 1.25
# How far a motor may drive its joint on beyond a limit of its position: what the encoder errs by, and a joint
# that is led back against its load is let down and pushed again. The way that braking takes is no driving.
OUTWARD_RAD = 0.02
# How much warmer than its limit a winding is that drives: the sensor errs by less [K]. A module that hangs
# does not look; its motor is off after its lifetime.
HEAT_K, HEAT_TICKS = 3.0, LIFETIME_NS // TICK_NS + 2
# Ticks between looks at the motors' speeds, which change within tens of milliseconds.
SPEED_TICKS = 8
# A PWM at 48 V; no command of a module may be larger.
MAX_PWM = 1.0
# What the checks of PWM, speeds and positions look at.
_LOOKED_AT = [ASKED, PLANT_MOTOR_RAD_S, Q_RAD]


class _Held(NamedTuple):
    """A lease: the boot of its module, the endpoint that it was granted, and until when by the world [ns].

    since_ns: when it was granted, by the module's clock. by: "none" of a lease that was released.
    """

    boot: int
    by: str
    until_ns: int
    since_ns: int


class _Request(NamedTuple):
    """What was asked of a module: by which endpoint, the bytes, and whether a lease was to be acquired."""

    by: str
    payload: bytes
    acquires: bool


class _Usual(NamedTuple):
    """Around what and within what the rows `_LOOKED_AT` of all modules usually are, (3, n) each."""

    centre: Array
    reach: Array


class PlantWitness:
    """Notes violations by the motors: `violations` maps each kind to the first case of it, as a sentence.

    seen_until_ns: the end of what it has judged, by the world.

    Args:
        commanders: the names of endpoints on the network that may command, and in whose name each does.
        ranges: the configured range of position of each module that is to keep it, by serial [rad].
        speeds: the configured speeds of modules that have one, by serial [rad/s].
    """

    def __init__(
        self,
        commanders: Mapping[str, str],
        ranges: Mapping[str, tuple[float, float]] = MappingProxyType({}),
        speeds: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        self.violations: dict[str, str] = {}
        self.seen_until_ns = 0
        self._commanders = commanders
        self._ranges = ranges
        self._configured_rad_s = speeds
        # How far each joint has been driven on since it left its range.
        self._outward_rad = dict.fromkeys(ranges, 0.0)
        # For how many ticks each motor has been driven that is too hot.
        self._hot_ticks: dict[str, int] = {}
        self._sent_ns: dict[str, int] = {}
        self._accepted_ns: dict[str, int] = {}
        # When modules accepted a stop that no acquisition has ended since.
        self._stopped_ns: dict[str, int] = {}
        # The newest request of each number to a module, and who first sent a set-point of a position.
        self._requests: dict[tuple[str, Leaf, int], _Request] = {}
        self._setpoints: dict[str, dict[float, str]] = {}
        self._leases: dict[str, _Held] = {}
        self._usual: _Usual | None = None
        # The motors' speeds in the last tick.
        self._speeds: Array | None = None

    def tap(self, now_ns: int, endpoint: str, kind: str, key: str, payload: bytes) -> None:
        """Note who commands which module, and what that accepts; a `Tap` of the virtual network.

        `now_ns` is when a program sent it: of what was delayed on the way to the network that is earlier.
        """
        try:
            parts = parse(key)
        except WireError:
            return
        if kind == "reply":
            if endpoint == parts.serial and parts.leaf in (*COMMANDS, Leaf.STOP):
                with suppress(WireError):
                    self._answered(now_ns, parts, decode(Ack, payload))
            return
        if parts.leaf in COMMANDS and self._may_command(endpoint, parts.serial):
            self._sent_ns[parts.serial] = max(now_ns, self._sent_ns.get(parts.serial, now_ns))
            if kind == "sample":
                # Nothing answers what is published: a command that is refused counts, too.
                self._accepted_ns[parts.serial] = max(now_ns, self._accepted_ns.get(parts.serial, now_ns))
        if parts.leaf is Leaf.SETPOINT:
            self._streamed(parts.serial, endpoint, payload)
        elif parts.leaf is Leaf.LEASE or (parts.leaf in _REQUESTS and kind == "request"):
            self._asked(parts, endpoint, payload)
        elif parts.leaf is Leaf.FEEDBACK and parts.serial in self._setpoints and endpoint == parts.serial:
            self._follows(parts.serial, payload)

    def _answered(self, now_ns: int, parts: KeyParts, ack: Ack) -> None:
        if not ack.accepted:
            return
        serial, leaf = parts.serial, parts.leaf
        if leaf is Leaf.STOP:
            self._stopped_ns.setdefault(serial, now_ns)
            return
        self._accepted_ns[serial] = now_ns
        asked, held = self._requests.get((serial, leaf, ack.re)), self._leases.get(serial)
        asker = "?" if asked is None else asked.by
        acquires = leaf is Leaf.LEASE and (asked is None or asked.acquires)
        if not acquires and asked is not None:
            self._check_holder(serial, f"accepts {leaf.value} of", asker)
        if leaf is not Leaf.LEASE:
            return
        if ack.holder is None:
            self._leases[serial] = _Held(ack.boot, "none", now_ns, ack.t_ns)
            return
        if acquires:
            # Nothing else ends a stop. A keep-alive of a motion that is done is accepted after it, too.
            self._stopped_ns.pop(serial, None)
            if asker not in self._commanders.values():
                # Without security a robot that is free is anybody's.
                self._sent_ns[serial] = max(now_ns, self._sent_ns.get(serial, now_ns))
        if held is not None and held.boot == ack.boot and now_ns < held.until_ns and held.by != asker:
            self._note("two holders", f"module {serial} is held by {held.by} and obeys {asker}")
        since_ns = ack.t_ns if acquires or held is None else held.since_ns
        self._leases[serial] = _Held(ack.boot, asker, now_ns + ack.lease_left_ns, since_ns)

    def _may_command(self, endpoint: str, serial: str) -> bool:
        """Return whether a program's commands keep a motor on: a coordinator's, or those of who holds it."""
        return endpoint in self._commanders or (
            serial in self._leases and self._leases[serial].by == endpoint
        )

    def _asked(self, parts: KeyParts, endpoint: str, payload: bytes) -> None:
        try:
            request = decode(_REQUESTS[parts.leaf], payload)
        except WireError:
            return
        before = self._requests.get((parts.serial, parts.leaf, request.seq))
        if before is not None and before.payload == payload:
            # A copy of a request is no request of who copied it.
            return
        acquires = isinstance(request, LeaseRequest) and request.action == "acquire"
        asked = _Request(self._commanders.get(endpoint, endpoint), payload, acquires)
        self._requests[parts.serial, parts.leaf, request.seq] = asked

    def _streamed(self, serial: str, endpoint: str, payload: bytes) -> None:
        try:
            position_rad = decode(Setpoint, payload).position_rad
        except WireError:
            return
        if position_rad is not None:
            by = self._commanders.get(endpoint, endpoint)
            self._setpoints.setdefault(serial, {}).setdefault(position_rad, by)

    def _follows(self, serial: str, payload: bytes) -> None:
        """Judge whose set-points a module follows by its own rows."""
        try:
            feedback = decode(Feedback, payload, MAX_MESSAGE_BYTES)
            rows = unpack(feedback)
        except WireError:
            return
        held = self._leases.get(serial)
        if held is not None:
            # The rows of a message may begin before the lease does.
            rows = rows[rows["t_ns"] > held.since_ns] if held.boot == feedback.boot else rows[:0]
        for target_rad in rows["position_command_rad"][rows["state"] == _STREAMING].tolist():
            by = self._setpoints[serial].get(target_rad)
            if by is not None:
                self._check_holder(serial, "follows a set-point of", by)

    def _check_holder(self, serial: str, does: str, by: str) -> None:
        held = self._leases.get(serial)
        holder = "none" if held is None else held.by
        if holder != by:
            self._note("command of a stranger", f"module {serial} {does} {by}, its holder is {holder}")

    def check(self, robot: VirtualRobot, seen: Array) -> None:
        """Judge what the motors did in the ticks (T, rows, n) that have just ended; see `QuietRun.seen`."""
        self.seen_until_ns = robot.world.t_ns
        first_ns = robot.world.t_ns - len(seen) * TICK_NS
        if self._usual is None:
            self._usual = self._usual_of(robot)
        off = np.abs(seen[:, _LOOKED_AT] - self._usual.centre)
        # Nearly all ticks: one look for all, for the checks below would find nothing.
        if not (off <= self._usual.reach).all():
            self._check_asked(robot.serials, first_ns, seen[:, ASKED])
            first_look = -(first_ns // TICK_NS) % SPEED_TICKS
            if first_look < len(seen):
                looked_ns = first_ns + first_look * TICK_NS
                self._check_speeds(robot, looked_ns, seen[first_look::SPEED_TICKS])
            self._check_positions(robot.serials, first_ns, seen)
        elif any(self._outward_rad.values()):
            self._outward_rad = dict.fromkeys(self._ranges, 0.0)
        self._check_heat(robot, seen[:, PLANT_PWM])
        speeds, last = seen[:, PLANT_MOTOR_RAD_S], self._speeds
        for k, module in enumerate(robot.robot.modules):
            pwm = seen[:, PLANT_PWM, k]
            if module.serial in self._stopped_ns:
                read = np.append(speeds[0, k] if last is None else last[k], speeds[:-1, k])
                self._check_stopped(module.serial, module_type(module.type), first_ns, pwm, read)
            else:
                self._check_late(module.serial, first_ns, pwm)
        self._speeds = speeds[-1].copy()

    def _usual_of(self, robot: VirtualRobot) -> "_Usual":
        """Return what no check finds anything in."""
        speeds = self._max_speeds(robot)
        ends = np.array([self._ranges.get(serial, (-np.inf, np.inf)) for serial in robot.serials])
        bounded = np.isfinite(ends[:, 0])
        centre, reach = np.zeros((2, len(_LOOKED_AT), speeds.size))
        reach[0], reach[1] = MAX_PWM, SPEED_MARGIN * speeds
        # Rounding is no reason to look less: a little less than the range.
        centre[2, bounded] = ends[bounded].mean(axis=1)
        reach[2] = np.where(bounded, 0.5 * (1.0 - 1e-9) * (ends[:, 1] - ends[:, 0]), np.inf)
        return _Usual(centre, reach)

    def _max_speeds(self, robot: VirtualRobot) -> Array:
        """Return the speed of each module's type, or what it is configured to."""
        configured = self._configured_rad_s
        return np.array(
            [configured.get(m.serial, module_type(m.type).max_speed_rad_s) for m in robot.robot.modules]
        )

    def _check_asked(self, serials: Sequence[str], first_ns: int, asked: Array) -> None:
        """Judge what the modules ask their bridges for, (T, n): the plant's bridges clip it."""
        if np.abs(asked).max() <= MAX_PWM:
            return
        # Nor is what is not a number within it.
        tick, k = np.argwhere(~(np.abs(asked) <= MAX_PWM))[0].tolist()
        text = (
            f"module {serials[k]} at {(first_ns + tick * TICK_NS) / 1e9:.3f} s asked {asked[tick, k]:.3f}, "
            f"expected at most {MAX_PWM:.0f}"
        )
        self._note("PWM out of range", text)

    def _check_speeds(self, robot: VirtualRobot, first_ns: int, seen: Array) -> None:
        """Judge motors that are driven on, (T, rows, n): a load may turn one that is off, or brakes."""
        limits, speeds = self._max_speeds(robot), seen[:, PLANT_MOTOR_RAD_S]
        within = (np.abs(speeds) <= SPEED_MARGIN * limits) | (speeds * seen[:, PLANT_PWM] <= 0.0)
        if within.all():
            return
        tick, k = np.argwhere(~within)[0].tolist()
        at_s = (first_ns + (tick * SPEED_TICKS + 1) * TICK_NS) / 1e9
        text = f"module {robot.serials[k]} at {at_s:.3f} s: {speeds[tick, k]:.2f} rad/s of {limits[k]:.2f}"
        self._note("speed beyond the limit", text)

    def _check_heat(self, robot: VirtualRobot, pwm: Array) -> None:
        """Judge motors that were driven in all of some ticks, (T, n), and are too hot at their end."""
        winding_c = robot.world.winding_c
        if not self._hot_ticks and winding_c.max() < UNCONFIGURED.winding_c + HEAT_K:
            return
        too_hot = (pwm != 0.0).all(axis=0) & (winding_c >= UNCONFIGURED.winding_c + HEAT_K)
        before, self._hot_ticks = self._hot_ticks, {}
        for k in np.flatnonzero(too_hot):
            serial = robot.serials[k]
            self._hot_ticks[serial] = ticks = before.get(serial, 0) + len(pwm)
            if ticks > HEAT_TICKS:
                text = (
                    f"module {serial} at {robot.world.t_ns / NS_PER_S:.3f} s: driven for {ticks} ticks at "
                    f"{winding_c[k]:.0f} C of {UNCONFIGURED.winding_c:.0f} C"
                )
                self._note("driven too hot", text)

    def _check_positions(self, serials: Sequence[str], first_ns: int, seen: Array) -> None:
        """Judge where the motors drive their joints, in the ticks (T, rows, n).

        A load may carry a joint beyond its limit, and so does its speed where it cannot brake in time. What
        no motor may do is push a joint on that is there already.
        """
        for serial, (low, high) in self._ranges.items():
            k = serials.index(serial)
            q = seen[:, Q_RAD, k]
            if low <= q.min() and q.max() <= high:
                self._outward_rad[serial] = 0.0
                continue
            out = np.where(q > high, 1.0, np.where(q < low, -1.0, 0.0))
            speed = out * seen[:, QD_RAD_S, k]
            driven = (out * seen[:, PLANT_PWM, k] > 0.0) & (speed > 0.0)
            steps = np.where(driven, speed * (TICK_NS / NS_PER_S), 0.0)
            ways = np.cumsum(steps)
            # The way begins anew within the range; before these ticks it may have begun already.
            ways -= np.maximum.accumulate(np.where(out == 0.0, ways, -self._outward_rad[serial]))
            self._outward_rad[serial] = float(ways[-1])
            farthest = int(np.argmax(ways))
            if ways[farthest] > OUTWARD_RAD:
                at_s = (first_ns + (farthest + 1) * TICK_NS) / NS_PER_S
                text = (
                    f"module {serial} at {at_s:.3f} s: driven on by {ways[farthest]:.3f} rad beyond "
                    f"{low:.3f} .. {high:.3f} rad, to {q[farthest]:.3f} rad"
                )
                self._note("driven beyond its range", text)

    def _check_late(self, serial: str, first_ns: int, pwm: Array) -> None:
        """Judge a motor, PWM (T,), after the lifetime of what it was commanded last: it is off."""
        sent_ns, accepted_ns = (of.get(serial, -LIFETIME_NS) for of in (self._sent_ns, self._accepted_ns))
        ended_ns = min(sent_ns, accepted_ns) + LIFETIME_NS
        # The first tick that is later than by two.
        late = max((ended_ns - first_ns) // TICK_NS + 3, 0)
        if late >= len(pwm) or not pwm[late:].any():
            return
        tick = late + int(np.argmax(pwm[late:] != 0.0))
        t_ns = first_ns + tick * TICK_NS
        text = f"PWM {pwm[tick]:.3f}, {(t_ns - ended_ns) / 1e6:.0f} ms after its lifetime ended"
        self._note("driven too late", f"module {serial} at {t_ns / 1e9:.3f} s: {text}")

    def _check_stopped(self, serial: str, kind: ModuleType, first_ns: int, pwm: Array, speed: Array) -> None:
        """Judge a motor from two ticks after a stop on: it is off, or it brakes.

        The brake follows the motor's speed, which a spring keeps apart from the output's, as it was read in
        the tick before: a spring changes it by tenths of rad/s in one. Before a limit of its position it is
        harder than elsewhere, and never harder than what the speed alone would induce.

        Args:
            pwm, speed: of ticks (T,); each speed is that of the tick before.
        """
        stopped_ns = self._stopped_ns[serial]
        begin = max((stopped_ns - first_ns) // TICK_NS + 2, 0)
        if begin >= len(pwm) or not pwm[begin:].any():
            return
        pwm, speed = pwm[begin:], speed[begin:]
        hardest = np.maximum(DAMPING_LIMIT_PWM, SPEED_MARGIN * np.abs(speed) / kind.max_speed_rad_s)
        brakes = (np.abs(pwm) <= hardest) & ((np.abs(speed) < SLOW_RAD_S) | (pwm * speed <= 0.0))
        wrong = (pwm != 0.0) & ~brakes
        if not wrong.any():
            return
        tick = int(np.argmax(wrong))
        t_ns = first_ns + (begin + tick) * TICK_NS
        text = (
            f"PWM {pwm[tick]:.3f} at {speed[tick]:.2f} rad/s, {(t_ns - stopped_ns) / 1e6:.0f} ms after it "
            "accepted a stop"
        )
        self._note("driven after a stop", f"module {serial} at {t_ns / 1e9:.3f} s: {text}")

    def _note(self, kind: str, text: str) -> None:
        self.violations.setdefault(kind, text)
