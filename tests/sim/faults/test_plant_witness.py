"""The witness tells a brake from drive by what was stopped and armed, in whatever order messages arrive."""

from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

from module_agent.wire.codec import encode
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import Ack, LeaseRequest
from sim.faults.plant_witness import LIFETIME_NS, PlantWitness

ROBOT, SERIAL, HOLDER = "arm", "A", "coordinator"
MS = 1_000_000
LATE_NS = LIFETIME_NS + 20 * MS


class Scene:
    """A coordinator and a module that talk, and what the witness finds long after that."""

    def __init__(self) -> None:
        self.witness = PlantWitness([HOLDER])
        self._now_ns = self._seq = 0

    def accept(self, leaf: Leaf, action: Literal["acquire", "renew"] | None = None) -> None:
        """Let the coordinator ask for something which the module grants."""
        self._now_ns += MS
        self._seq += 1
        at = key(ROBOT, SERIAL, leaf)
        payload = b""
        if action is not None:
            head: dict[str, Any] = {"serial": SERIAL, "boot": 1, "seq": self._seq, "sender": HOLDER}
            payload = encode(LeaseRequest(**head, token=1, echo_ns=1, action=action))
        self.witness.tap(self._now_ns, HOLDER, "request", at, payload)
        answer = Ack(
            serial=SERIAL,
            boot=1,
            seq=self._seq,
            re=self._seq,
            accepted=True,
            reason="",
            detail="",
            t_ns=1,
            holder=HOLDER,
            lease_left_ns=1000 * MS,
            token=1,
        )
        self.witness.tap(self._now_ns, SERIAL, "reply", at, encode(answer))

    def judged(self, pwm: float, speed_rad_s: float) -> set[str]:
        """Return what the witness notes of a motor that is driven after the lifetime of the last command."""
        plant = SimpleNamespace(
            pwm=np.array([pwm]), motor_rad_s=np.array([speed_rad_s]), t_ns=self._now_ns + LATE_NS
        )
        robot: Any = SimpleNamespace(
            serials=(SERIAL,),
            pwm=[pwm],
            world=SimpleNamespace(t_ns=self._now_ns + LATE_NS + MS, plant=plant),
            robot=SimpleNamespace(modules=[SimpleNamespace(type="X5-9")]),
        )
        self.witness.check(robot)
        return set(self.witness.violations)


def armed() -> Scene:
    scene = Scene()
    scene.accept(Leaf.LEASE, "acquire")
    scene.accept(Leaf.MOTION)
    return scene


def test_a_motor_that_was_only_commanded_may_not_even_brake_after_the_lifetime() -> None:
    assert armed().judged(pwm=0.018, speed_rad_s=-0.5) == {"driven too late"}


@pytest.mark.parametrize(("leaf", "action"), [(Leaf.MOTION, None), (Leaf.LEASE, "renew")])
def test_a_keep_alive_that_a_stop_has_overtaken_does_not_end_the_stop(leaf: Leaf, action: Any) -> None:
    """On a network that changes the order: the module damps its joint on, as seeds 24 and 2028 found."""
    scene = armed()
    scene.accept(Leaf.STOP)
    scene.accept(leaf, action)
    assert scene.judged(pwm=0.018, speed_rad_s=-0.5) == set()
    assert scene.judged(pwm=0.018, speed_rad_s=+0.5) == {"driven too late"}


def test_a_module_that_was_armed_after_a_stop_is_stopped_no_more() -> None:
    scene = armed()
    scene.accept(Leaf.STOP)
    scene.accept(Leaf.LEASE, "acquire")
    assert scene.judged(pwm=0.018, speed_rad_s=-0.5) == {"driven too late"}
