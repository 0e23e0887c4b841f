"""What the motors truly did, tick by tick, against what their modules had accepted.

The witness sees the plant and the bytes on the wire, and neither the firmware's state nor its opinion.
"""

import math

from module_agent.hardware.motor_guard import DAMPING_LIMIT_PWM
from module_agent.wire.codec import decode
from module_agent.wire.keys import Leaf, parse
from module_agent.wire.messages import Ack
from module_agent.wire.refusal import WireError
from sim.virtual_time.robot import VirtualRobot
from sim.world.world import TICK_NS

LIFETIME_NS = 250_000_000
COMMANDS = (Leaf.LEASE, Leaf.MOTION, Leaf.SETPOINT, Leaf.GAINS)
# Below this the sign of a speed is that of its noise on a springy joint [rad/s].
SLOW_RAD_S = 0.05
# A PWM at 48 V; no command of a module may be larger.
MAX_PWM = 1.0


class PlantWitness:
    """Notes violations by the motors: `violations` maps each kind to the first case of it, as a sentence."""

    def __init__(self) -> None:
        self.violations: dict[str, str] = {}
        self._accepted_ns: dict[str, int] = {}
        self._stopped: set[str] = set()

    def tap(self, now_ns: int, endpoint: str, kind: str, key: str, payload: bytes) -> None:
        """Note which module accepted a command or a stop, and when; a `Tap` of the virtual network."""
        if kind != "reply":
            return
        parts = parse(key)
        if parts.leaf not in (*COMMANDS, Leaf.STOP):
            return
        try:
            accepted = decode(Ack, payload).accepted
        except WireError:
            return
        if accepted and parts.leaf is Leaf.STOP:
            self._stopped.add(parts.serial)
        elif accepted:
            self._accepted_ns[parts.serial] = now_ns
            self._stopped.discard(parts.serial)

    def check(self, robot: VirtualRobot) -> None:
        """Judge what the motors did in the tick that ends."""
        plant = robot.world.plant
        for k, serial in enumerate(robot.serials):
            pwm, speed = float(plant.pwm[k]), float(plant.qd_rad_s[k])
            where = f"module {serial} at {plant.t_ns / 1e9:.3f} s: PWM {pwm:.3f}"
            # What the module asks its bridge for: the plant's bridge clips it.
            asked = float(robot.pwm[k])
            if not math.isfinite(asked) or abs(asked) > MAX_PWM:
                self._note("PWM out of range", f"{where} asked {asked:.3f}, expected at most {MAX_PWM:.0f}")
            late_ns = plant.t_ns - self._accepted_ns.get(serial, -LIFETIME_NS) - LIFETIME_NS
            if late_ns <= 2 * TICK_NS or pwm == 0.0:
                continue
            brakes = abs(pwm) <= DAMPING_LIMIT_PWM and (abs(speed) < SLOW_RAD_S or pwm * speed <= 0.0)
            if serial not in self._stopped or not brakes:
                self._note("driven too late", f"{where}, {late_ns / 1e6:.0f} ms after its lifetime ended")

    def _note(self, kind: str, text: str) -> None:
        self.violations.setdefault(kind, text)
