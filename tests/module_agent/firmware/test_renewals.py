"""Renewals of a lease leave the ticks quiet in which they come, and do what they do in the Python objects."""

from collections.abc import Iterator, Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.firmware.quiet_ticks import QuietTicks
from module_agent.host import MAX_RENEWALS
from module_agent.transport.transport import Request, Sample
from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import Ack, Ask, LeaseRequest, MotionCommand, Rest, Setpoint, Stop
from module_agent.wire.proof import proven
from tests.module_agent.firmware.test_quiet_ticks import (
    BOOT,
    MS,
    ROBOT,
    SERIALS,
    Agent,
    Life,
    first_difference,
)

SECRET = b"0123456789abcdef"
ACCEPTED: dict[str, Any] = {"asks": True}
# What is wrong with a renewal, and whether it asks for an answer.
RENEWALS = st.fixed_dictionaries(
    {"asks": st.booleans()},
    optional={
        "token": st.sampled_from([0, 2]),
        "boot": st.just(BOOT + 1),
        "sender": st.just("another"),
        "age_ms": st.sampled_from([-2, 30, 39, 41]),
        "again": st.just(True),
        "secret": st.sampled_from([b"", b"another's"]),
        "duration_ms": st.sampled_from([1, 20, 400]),
        "action": st.sampled_from(["acquire", "release"]),
        "garbage": st.just(True),
        "leaf": st.just(Leaf.GAINS),
    },
)
# What else happens to module 1 in the same tick.
BESIDES = st.sampled_from(
    ["", "", "", "ask", "stop", "hot", "sick", "forwards", "back", "stands", "move", "aim"]
)
# After how many ticks more the next renewals come: also just when leases of 20 and 90 ms lapse, commands of
# 40 ms expire and motions of 20 and 50 ms end.
EVENTS = st.lists(
    st.tuples(
        st.one_of(st.integers(0, 40), st.sampled_from([18, 19, 20, 38, 39, 40, 48, 49, 88, 89])),
        st.lists(st.tuples(st.integers(0, 2), RENEWALS), max_size=MAX_RENEWALS + 2),
        BESIDES,
    ),
    max_size=12,
)


class Holder:
    """Who holds the leases of all modules of some agents, and tells all agents the same."""

    def __init__(self, agents: Sequence[Agent], seed: int, jitter_ns: int = 20):
        self._agents, self.life = agents, Life(agents, seed, jitter_ns)
        self._seq = 0

    def acquire(self) -> None:
        self.life.ticks(3)
        for k in range(3):
            self.renew(k, {"asks": True, "action": "acquire", "duration_ms": 90})
        self.life.ticks(1)

    def renew(self, k: int, how: dict[str, Any]) -> None:
        """Send a renewal to a module, of the next tick."""
        self._seq += not how.get("again", False)
        action = how.get("action", "renew")
        request = LeaseRequest(
            serial=SERIALS[k],
            boot=how.get("boot", BOOT),
            seq=self._seq,
            sender=how.get("sender", "me"),
            token=how.get("token", 1),
            echo_ns=max(0, self.life._now[k] - how.get("age_ms", 1) * MS),
            action=action,
            duration_ns=how.get("duration_ms", 90) * MS,
            secret=SECRET if action == "acquire" else b"",
        )
        payload = proven(encode(request), how.get("secret", SECRET if action != "acquire" else b""))
        self._tell(k, how.get("leaf", Leaf.LEASE), payload[3:] if "garbage" in how else payload, how["asks"])

    def _tell(self, k: int, leaf: Leaf, payload: bytes, asks: bool) -> None:
        at = key(ROBOT, SERIALS[k], leaf)
        for agent in self._agents:
            sent = agent.network.sent
            answer: Any = lambda answer, sent=sent: sent.append((at + " answer", answer))  # noqa: E731
            agent.network.sinks[at](Request(at, payload, answer) if asks else Sample(at, payload))

    def happen(self, what: str) -> None:
        """Let something happen to module 1 in the next tick."""
        self._seq += 1
        head: dict[str, Any] = {"serial": "B", "boot": BOOT, "seq": self._seq, "sender": "me"}
        command = {**head, "token": 1, "echo_ns": max(0, self.life._now[1] - MS)}
        match what:
            case "ask":
                self._tell(1, Leaf.STATUS, encode(Ask(**head)), True)
            case "stop":
                self._tell(1, Leaf.STOP, encode(Stop(**head, why="test")), True)
            case "move":
                motion = MotionCommand(**command, motion_id=self._seq, pattern=Rest(duration_s=0.02))
                self._tell(1, Leaf.MOTION, proven(encode(motion), SECRET), True)
            case "aim":
                aim = Setpoint(**command, position_rad=0.1, velocity_rad_s=None, effort_nm=None)
                self._tell(1, Leaf.SETPOINT, proven(encode(aim), SECRET), False)
            case "hot":
                self.life._winding[1] = 160.0
            case "sick":
                self.life._sick[1] = "effort_nm", float("nan"), 2
            case "forwards":
                self.life._now[1] += 130 * MS
            case "back":
                self.life._now[1] -= 700 * MS
            case "stands":
                self.life._rate[1] = 1.0 - self.life._rate[1]


@pytest.fixture
def attended(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """The places whose renewals left their ticks quiet."""
    places, read_renewals = list[int](), QuietTicks.read_renewals

    def counted(self: QuietTicks, place: int, renewals: Any) -> Any:
        places.append(place)
        return read_renewals(self, place, renewals)

    monkeypatch.setattr(QuietTicks, "read_renewals", counted)
    return places


def both(rate_hz: float = 250.0, expiry: str = "hold") -> list[Agent]:
    return [Agent(is_compiled, 3, expiry, rate_hz) for is_compiled in (False, True)]


@settings(deadline=None, max_examples=80)
@given(
    st.integers(0, 2**32 - 1),
    EVENTS,
    st.sampled_from([250.0, 1000.0]),
    st.sampled_from(["hold", "damping", "motor_off"]),
    st.sampled_from([0, 20]),
)
def test_renewals_of_every_kind_do_the_same_in_both(
    seed: int,
    events: list[tuple[int, list[tuple[int, dict[str, Any]]], str]],
    rate_hz: float,
    expiry: str,
    jitter_ns: int,
) -> None:
    agents = both(rate_hz, expiry)
    holder = Holder(agents, seed, jitter_ns)
    holder.acquire()
    for ticks, renewals, besides in events:
        for k, how in renewals:
            holder.renew(k, how)
        holder.happen(besides)
        holder.life.ticks(1 + ticks)
    assert not first_difference(agents)
    refusals = [[module.firmware.admission.refusals for module in agent.host.modules] for agent in agents]
    assert refusals[0] == refusals[1]


@pytest.mark.parametrize("asks", [True, False], ids=["asked", "published"])
def test_leases_that_are_renewed_in_quiet_ticks_are_held_and_lapse_when_nothing_renews_them(
    asks: bool, attended: list[int]
) -> None:
    agents = both()
    holder = Holder(agents, 1)
    holder.acquire()
    for _ in range(20):
        for k in range(3):
            holder.renew(k, {"asks": asks})
        holder.life.ticks(25)
    assert [module.firmware.state for module in agents[1].host.modules] == ["armed"] * 3
    # A module that reports its status in the same tick is not quiet.
    assert len(attended) > 50
    answers = [decode(Ack, payload) for at, payload in agents[1].network.sent if at.endswith("lease answer")]
    assert len(answers) == (63 if asks else 3)
    assert all(answer.accepted for answer in answers)
    holder.life.ticks(30)
    assert [module.firmware.state for module in agents[1].host.modules] == ["expired"] * 3
    assert not first_difference(agents)


def test_a_renewal_leaves_the_rows_of_its_process_waiting(attended: list[int]) -> None:
    agents = both()
    holder = Holder(agents, 2)
    holder.acquire()
    kept, keep_rows = list[int](), QuietTicks.keep_rows

    def counted(self: QuietTicks, place: int) -> Any:
        kept.append(int(self._held[place]))
        return keep_rows(self, place)

    holder.life.ticks(10)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(QuietTicks, "keep_rows", counted)
        for _ in range(20):
            for k in range(3):
                holder.renew(k, ACCEPTED)
            holder.life.ticks(5)
    assert len(attended) == 60
    # Whole batches alone: of the first, the objects have kept a row.
    assert set(kept[3:]) == {5}
    assert not first_difference(agents)


def test_more_renewals_than_a_holder_sends_are_read_by_the_objects(attended: list[int]) -> None:
    agents = both()
    holder = Holder(agents, 3)
    holder.acquire()
    holder.life.ticks(20)
    for count, places in ((MAX_RENEWALS, [2]), (MAX_RENEWALS + 1, [])):
        attended.clear()
        for _ in range(count):
            holder.renew(2, ACCEPTED)
        holder.life.ticks(1)
        assert attended == places
    assert not first_difference(agents)


def test_nothing_but_renewals_leaves_a_tick_quiet(attended: list[int]) -> None:
    agents = both()
    holder = Holder(agents, 4)
    holder.acquire()
    for what in ("ask", "stop"):
        holder.life.ticks(7)
        attended.clear()
        holder.renew(1, ACCEPTED)
        holder.happen(what)
        holder.life.ticks(1)
        assert attended == []
    # A renewal on a key that is not the lease's is none.
    attended.clear()
    holder.renew(2, ACCEPTED | {"leaf": Leaf.GAINS})
    holder.life.ticks(1)
    assert attended == []
    # Of a module that is stopped leases are renewed, too.
    assert agents[1].host.modules[1].firmware.state == "stopped"
    holder.renew(1, ACCEPTED)
    holder.life.ticks(1)
    assert attended == [1]
    assert not first_difference(agents)
