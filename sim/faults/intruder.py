"""A program on the robot's network that hears everything and sends what no coordinator would.

Packets that ended agents once, commands in the holder's name with all that is published, copies of commands
that it overheard, a module that does not exist, and garbage. What succeeds by its nature where nothing on the
network tells who spoke (forged rows, answers in a module's place) is not among them: see the documentation
of security.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgpack
import numpy as np

from module_agent.transport.transport import Event, Sample, Transport
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode
from module_agent.wire.feedback_rows import unpack
from module_agent.wire.keys import ROOT, Leaf, every, key
from module_agent.wire.messages import SCHEMA_VERSION, Feedback
from module_agent.wire.refusal import WireError

OVERHEARD = (Leaf.LEASE, Leaf.MOTION, Leaf.SETPOINT, Leaf.GAINS)
HUGE = 2**62
# Coordinators, and programs with their secret, number less: answers tell whose command they are about.
_FIRST_SEQ = 2_000_000
# From where a joint is to where it is told to go: every module's range has room for it on one side at least.
ASIDE_RAD, SPEED_RAD_S = 0.3, 0.5
# Copies of commands: of the newest so many.
_REMEMBERED = 16


class Intruder:
    """Attacks one module in one way, a few packets a call; `attack` is the number of it in `ATTACKS`.

    period_s: how often it is to strike.
    """

    period_s = 0.02

    def __init__(self, transport: Transport, robot: str, serial: str, attack: int, seed: int):
        self._transport = transport
        self._robot = robot
        self._serial = serial
        self._attack = ATTACKS[attack]
        self._rng = np.random.default_rng(seed)
        self._status: dict[str, Any] = {}
        # The newest time that the module tells, and where its joint was: None before it was heard.
        self._seen: tuple[int, float] | None = None
        self._overheard: list[tuple[Leaf, bytes]] = []
        self._sent = 0
        self._aside_rad = ASIDE_RAD
        self._declared = False
        # Serials of modules that were heard, in the order of their first status.
        self._modules: dict[str, None] = {}
        transport.subscribe(every(robot, Leaf.STATUS), self._hear)
        transport.subscribe(key(robot, serial, Leaf.FEEDBACK), self._hear_rows)

    def overhear(self, leaf: Leaf, payload: bytes) -> None:
        """Take note of a command to the module."""
        self._overheard = [*self._overheard[1 - _REMEMBERED :], (leaf, payload)]

    def strike(self) -> None:
        """Send the packets of one moment."""
        self._attack(self)

    def close(self) -> None:
        """Leave the network."""
        self._transport.close()

    def _hear(self, event: Event) -> None:
        if isinstance(event, Sample):
            try:
                heard = msgpack.unpackb(event.payload)
            except ValueError:
                return
            if not isinstance(heard, dict):
                return
            self._modules[str(heard.get("serial"))] = None
            if heard.get("serial") == self._serial:
                self._status = heard

    def _hear_rows(self, event: Event) -> None:
        if isinstance(event, Sample):
            with suppress(WireError):
                rows = unpack(decode(Feedback, event.payload, MAX_MESSAGE_BYTES))
                if len(rows):
                    self._seen = int(rows["t_ns"][-1]), float(rows["position_rad"][-1])

    def _publish(self, at: str, message: dict[str, Any]) -> None:
        self._transport.publish(at, msgpack.packb(message))

    def _ask(self, leaf: Leaf, payload: bytes) -> None:
        self._sent += 1
        at = key(self._robot, self._serial, leaf)
        self._transport.query(at, payload, 0.5, lambda event: None, self._sent)

    def poison(self) -> None:
        """Publish statuses of a module that cannot be, of motions without end, and estimates of none."""
        record = {"motion_id": 1, "pattern": {"kind": "rest", "duration_s": 1.0}, "outcome": "running"}
        rows = {"start_ns": 0, "start_row": 0, "end_row": HUGE, "origin_rad": 0.0}
        # The one that it has, as if it were done already.
        endless = (self._status.get("motion") or record | rows) | {"outcome": "done", "end_row": None}
        wrong_motions = {"motion": record | rows}, {"motion": endless}
        # Coordinators hear the one key, the other modules the other.
        for leaf in (Leaf.STATUS, Leaf.MOTION):
            for wrong in ({"serial": "-bad"}, {"next_row": HUGE}, *wrong_motions, {"t_ns": -HUGE}):
                self._publish(key(self._robot, self._serial, leaf), self._status | wrong)
            self._publish(f"{ROOT}/{self._robot}/-bad/{leaf.value}", self._status | {"serial": "-bad"})
        for joint in list(self._modules):
            self._publish(key(self._robot, self._serial, Leaf.ESTIMATE), self._estimate_of(joint))

    def _estimate_of(self, joint: str) -> dict[str, Any]:
        """Return an estimate of a joint by the module, from no motion at all."""
        head = {name: self._status.get(name, 0) for name in ("boot", "seq", "t_ns")}
        nothing = {"motion_ids": (), "moved": True, "rate_ratio": 1.0, "circle": None, "regression": None}
        body = {"joint": joint, "gravity_m_s2": (0.0, 0.0, 9.81), "note": ""}
        return {"v": SCHEMA_VERSION, "serial": self._serial} | head | nothing | body

    def impersonate(self) -> None:
        """Command in the holder's name, as a module publishes it, what the module's limits allow.

        Of a lease, a motion and a set-point each: with the token that the module publishes, and without.
        """
        status, seen = self._status, self._seen
        if not status.get("holder") or seen is None:
            return
        echo_ns, position_rad = seen
        self._aside_rad = -self._aside_rad
        target_rad = position_rad + self._aside_rad
        for token in (status["token"], 0):
            aims = {"position_rad": target_rad, "velocity_rad_s": None, "effort_nm": None}
            path = {"kind": "goto", "target_rad": target_rad, "max_speed_rad_s": SPEED_RAD_S}
            motion = {"motion_id": _FIRST_SEQ + self._sent, "pattern": path}
            lease = {"duration_ns": 1_000_000_000, "secret": b"a-guess-of-16-b!"}
            self._publish(key(self._robot, self._serial, Leaf.SETPOINT), self._head(token, echo_ns) | aims)
            self._ask(Leaf.MOTION, msgpack.packb(self._head(token, echo_ns) | motion))
            for action in ("acquire", "renew", "release"):
                self._ask(Leaf.LEASE, msgpack.packb(self._head(token, echo_ns) | lease | {"action": action}))

    def _head(self, token: int, echo_ns: int) -> dict[str, Any]:
        """Return what every command in the holder's name begins with."""
        return {
            "v": SCHEMA_VERSION,
            "serial": self._serial,
            "boot": self._status["boot"],
            "seq": _FIRST_SEQ + self._sent,
            "sender": self._status["holder"],
            "token": token,
            "echo_ns": echo_ns,
        }

    def replay(self) -> None:
        """Send again what was overheard."""
        for leaf, payload in list(self._overheard):
            if leaf is Leaf.SETPOINT:
                self._transport.publish(key(self._robot, self._serial, leaf), payload)
            else:
                self._ask(leaf, payload)

    def haunt(self) -> None:
        """Be a module that is not there."""
        if not self._declared:
            self._declared = True
            self._transport.declare_alive(key(self._robot, "GHOST", Leaf.ALIVE))

    def litter(self) -> None:
        """Send random bytes to every key of the module."""
        for leaf in Leaf:
            garbage = self._rng.bytes(int(self._rng.integers(1, 200)))
            self._transport.publish(key(self._robot, self._serial, leaf), garbage)
            self._ask(leaf, garbage)


ATTACKS: tuple[Callable[[Intruder], None], ...] = (
    Intruder.poison,
    Intruder.impersonate,
    Intruder.replay,
    Intruder.haunt,
    Intruder.litter,
)
