"""A module's own messages with a field that is otherwise: whatever they say, they end as messages do.

Where nothing on the network tells who spoke, forged messages may stop a session or mislead it; see the
documentation of security. None may end a program by a defect.
"""

import random
from typing import Any

import msgpack
import pytest

from module_agent.transport.transport import Event, Sample
from module_agent.wire.keys import Leaf, every
from sim.faults import intruder
from sim.faults.fault import Fault
from sim.faults.report import run_seed
from sim.faults.schedule import draw
from tests.breadth import breadth
from tests.forgery import altered


class Forger:
    """An attack of `Intruder`: hears the robot's messages, and sends the newest with one field altered.

    Its own as well, so that alterations add up.
    """

    def __init__(self, seed: int):
        self.sent = 0
        self._draw = random.Random(seed)
        self._newest: dict[str, dict[str, Any]] = {}

    def __call__(self, own: intruder.Intruder) -> None:
        if not self.sent:
            for leaf in (Leaf.STATUS, Leaf.ESTIMATE, Leaf.FEEDBACK, Leaf.MOTION):
                own._transport.subscribe(every(own._robot, leaf), self._hear)
        self.sent += 1
        for at in self._draw.sample(list(self._newest), min(2, len(self._newest))):
            own._publish(at, altered(self._newest[at], self._draw))

    def _hear(self, event: Event) -> None:
        if isinstance(event, Sample):
            self._newest[event.key] = msgpack.unpackb(event.payload)


@pytest.mark.parametrize("seed", [8, 10, 14, 19, *breadth(*range(20, 50))])
def test_no_message_with_a_field_that_is_otherwise_ends_a_program_by_a_defect(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    forger, when = Forger(seed), random.Random(seed)
    monkeypatch.setattr(intruder, "ATTACKS", (forger, *intruder.ATTACKS[1:]))
    fault = Fault("intruder", when.uniform(0.5, 15.0), when.choice((0.5, 5.0, 30.0)), 0, 0.05)
    found = run_seed(draw(seed)._replace(faults=(fault,)), shrinks=False)
    assert forger.sent > 20
    assert not found.violations.keys() & {"traceback", "agent died", "unreadable recording", "unbounded"}
