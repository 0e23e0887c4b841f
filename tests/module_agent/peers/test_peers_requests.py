"""Whatever a peer asks about torques, it gets an answer, and the modules of the process go on ticking."""

import math
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.firmware.config import config_of
from module_agent.hardware.hardware import SensorSample, WiredModule
from module_agent.hardware.loop_inside import LoopInside
from module_agent.host import AgentHost, InlineWorker
from module_agent.torque_information import module_information
from module_agent.torque_information.service import Worker
from module_agent.transport.transport import Reply, Request, Sink
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.information_messages import MAX_OFFSET_NS, MAX_TIME_NS, Information
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import Ack, HistoryRequest
from module_agent.wire.refusal import WireError
from module_agent.worker import ThreadWorker

ROBOT, BOOT, TICK_NS, STEP_NS = "bench", 7, 1_000_000, 4_000_000
OWN, NEXT, FAR = "J1", "J2", "J3"
# Enough for the low-pass and the spline; a row is four ticks.
ROWS = 300


class Swinging:
    """Two modules that swing."""

    modules = tuple(WiredModule(serial, "X5-4", TICK_NS, STEP_NS) for serial in (OWN, NEXT))

    def __init__(self) -> None:
        self.ticks = 0

    def exchange(self, pwm: Sequence[float]) -> Sequence[SensorSample]:
        self.ticks += 1
        t_ns, turn = self.ticks * TICK_NS, math.sin(6.0 * 1e-3 * self.ticks)
        sample = SensorSample(t_ns, t_ns, turn, 0.0, 2.0 * turn, 0, 0, 0, 25.0, 36.0, 0, 0, 0, 0, 0, 9.81)
        return [sample for _ in self.modules]

    def close(self) -> None:
        pass


class _Declared:
    def undeclare(self) -> None:
        pass


class Wires:
    """A transport that hands over what the test says, and keeps what is asked and answered."""

    def __init__(self) -> None:
        self.sinks: dict[str, Sink] = {}
        self.queries: list[tuple[str, HistoryRequest, Sink, int]] = []

    def publish(self, key: str, payload: bytes) -> None:
        pass

    def subscribe(self, key_expr: str, sink: Sink) -> _Declared:
        return _Declared()

    def serve(self, key_expr: str, sink: Sink) -> _Declared:
        self.sinks[key_expr] = sink
        return _Declared()

    def query(self, key: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
        self.queries.append((key, decode(HistoryRequest, payload), sink, tag))

    def declare_alive(self, key: str) -> _Declared:
        return _Declared()

    def watch_alive(self, key_expr: str, sink: Sink) -> _Declared:
        return _Declared()

    def close(self) -> None:
        pass


class Bench:
    """One agent process with its two modules, after a while of swinging."""

    def __init__(self, worker: Worker):
        self.wires = Wires()
        modules = LoopInside(Swinging())
        configs = [config_of(module, BOOT) for module in modules.information]
        self.host = AgentHost(ROBOT, modules, self.wires, configs, worker)
        for _ in range(4 * (ROWS + 5)):
            self.host.cycle()
        self.refusals = self.host.modules[0].firmware.admission.refusals

    def ask(self, leaf: Leaf, message: dict[str, Any]) -> bytes:
        """Send, let one tick pass, return the answer."""
        answers: list[bytes] = []
        where = key(ROBOT, OWN, leaf)
        self.wires.sinks[where](Request(where, msgpack.packb(message), answers.append))
        self.host.cycle()
        (answer,) = answers
        return answer

    def refused(self, leaf: Leaf, message: dict[str, Any]) -> Ack:
        found = decode(Ack, self.ask(leaf, message))
        assert not found.accepted
        return found

    def collect(self, message: dict[str, Any]) -> None:
        assert decode(Ack, self.ask(Leaf.COLLECT, message)).accepted


def head(serial: str = OWN) -> dict[str, Any]:
    return {"v": 1, "serial": serial, "boot": BOOT, "seq": 1, "sender": "c"}


def rows(serial: str, first: int = 0, end: int = ROWS, boot: int = BOOT) -> dict[str, Any]:
    return {"serial": serial, "boot": boot, "first_row": first, "end_row": end}


def collecting(*wanted: dict[str, Any], motion_id: int = 1) -> dict[str, Any]:
    return {**head(), "motion_id": motion_id, "rows": list(wanted)}


def asking(**changes: Any) -> dict[str, Any]:
    """Return a question that is answered."""
    begin = 40 * STEP_NS
    geometry = [0.0, 0.0, 1.0, 0.1, 0.2, 0.3, *[1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]]
    span = {"motion_id": 1, "start_ns": begin, "end_ns": begin + 200 * STEP_NS, "first_ns": begin}
    return {
        **head(),
        "chain": {
            "serials": [OWN, NEXT],
            "parent": [-1, 0],
            "reversed": [False, False],
            "geometry": struct.pack("<44d", *geometry, *geometry),
            "gravity_m_s2": [0.0, 1.0, 9.7],
        },
        "clocks": [{"origin_ns": 0, "offset_ns": 0.0, "drift": 0.0} for _ in range(2)],
        "motions": [{**span, "samples": 200}],
        "step_ns": STEP_NS,
        "cutoff_hz": 12.0,
        "offset": 0,
        **changes,
    }


def clocked(**changes: Any) -> dict[str, Any]:
    return asking(clocks=[{**clock, **changes} for clock in asking()["clocks"]])


def timed(**changes: Any) -> dict[str, Any]:
    return asking(motions=[{**asking()["motions"][0], **changes}])


@pytest.fixture(params=[InlineWorker, ThreadWorker])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    worker = request.param()
    yield Bench(worker)
    if isinstance(worker, ThreadWorker):
        worker.close()


@pytest.fixture
def plain() -> Bench:
    return Bench(InlineWorker())


def test_a_good_question_is_answered(plain: Bench) -> None:
    plain.collect(collecting(rows(OWN), rows(NEXT)))
    plain.ask(Leaf.INFORMATION, asking())
    found = decode(Information, plain.ask(Leaf.INFORMATION, asking()), MAX_MESSAGE_BYTES)
    assert found.total_bytes == len(found.part)


@pytest.mark.parametrize("end", [5, 3, 100_006])
def test_a_range_of_no_rows_or_of_too_many_is_refused_for_every_module(plain: Bench, end: int) -> None:
    wrong = plain.refused(Leaf.COLLECT, collecting(rows(OWN), rows(NEXT), rows(FAR, 5, end)))
    assert wrong.reason == "range"
    assert f"rows 5 to {end} of J3: 1 to 100000 rows" in wrong.detail
    plain.host.cycle()
    # Nothing of it is kept.
    unknown = plain.refused(Leaf.INFORMATION, asking())
    assert "motion 1 was not collected here" in unknown.detail


def test_rows_of_a_module_are_asked_for_once_in_a_motion(plain: Bench) -> None:
    wrong = plain.refused(Leaf.COLLECT, collecting(rows(OWN), rows(FAR, 5, 9), rows(FAR, 6, 10)))
    assert (wrong.reason, "J3 are asked for twice" in wrong.detail) == ("range", True)


def test_own_rows_of_a_former_boot_are_refused_and_leave_no_motion(plain: Bench) -> None:
    for serial in (OWN, NEXT):
        wanted = [rows(s, boot=BOOT - (s == serial)) for s in (OWN, NEXT)]
        wrong = plain.refused(Leaf.COLLECT, collecting(*wanted))
        assert wrong.reason == "wrong_boot"
        assert serial in wrong.detail
        assert plain.refused(Leaf.INFORMATION, asking()).reason == "gone"


@pytest.mark.parametrize(
    "wrong",
    [
        clocked(offset_ns=1e19),
        clocked(offset_ns=-1e19),
        clocked(origin_ns=2**63 - 1),
        timed(start_ns=-(2**63)),
        timed(end_ns=2**63 - 1),
        timed(first_ns=2**63 - 1),
        asking(cutoff_hz=5e-324),
    ],
)
def test_times_beyond_what_64_bits_add_up_are_refused(bench: Bench, wrong: dict[str, Any]) -> None:
    bench.collect(collecting(rows(OWN), rows(NEXT)))
    assert bench.refused(Leaf.INFORMATION, wrong).reason == "range"
    for _ in range(5):
        bench.host.cycle()


def test_more_work_than_a_module_has_time_for_is_refused_before_it_is_begun(plain: Bench) -> None:
    plain.collect(collecting(rows(OWN), rows(NEXT)))
    serials = [f"J{number}" for number in range(64)]
    chain = {**asking()["chain"], "serials": serials, "parent": [-1] * 64, "reversed": [False] * 64}
    motions = [{**asking()["motions"][0], "samples": 65_536}] * 2
    wrong = plain.refused(Leaf.INFORMATION, asking(chain=chain, motions=motions))
    assert wrong.reason == "range"
    assert "131072 samples of 64 modules: at most 48828" in wrong.detail


def test_a_defect_caused_by_a_request_is_reported_and_counted_and_ends_nothing(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any) -> None:
        raise OverflowError("cannot convert float infinity to integer")

    monkeypatch.setattr(module_information, "own_information", broken)
    bench.collect(collecting(rows(OWN), rows(NEXT)))
    found = decode(Ack, bench.ask(Leaf.INFORMATION, asking()))
    # A thread takes as long as it takes; its end is what lets the loop go on.
    while found.reason == "busy":
        found = decode(Ack, bench.ask(Leaf.INFORMATION, asking()))
    assert found.reason == "unfit"
    assert "J1 cannot compute this, OverflowError: cannot convert float infinity" in found.detail
    assert bench.refusals == {"unfit": 1}


def refuse(plain: Bench, number: int, serial: str = FAR) -> None:
    _, asked, sink, tag = plain.wires.queries[number]
    ack = Ack(
        serial=serial,
        boot=BOOT,
        seq=1,
        re=0,
        accepted=False,
        reason="gone",
        detail="",
        t_ns=0,
        holder=None,
        lease_left_ns=0,
        token=0,
    )
    sink(Reply(tag, key(ROBOT, asked.serial, Leaf.HISTORY), encode(ack)))
    plain.host.cycle()


def one_motion_far_away(plain: Bench, motion_id: int, first: int) -> None:
    plain.collect(collecting(rows(OWN), rows(FAR, first, first + 9), motion_id=motion_id))


def why(plain: Bench, motion_id: int) -> str:
    return plain.refused(Leaf.INFORMATION, timed(motion_id=motion_id)).reason


def test_a_refusal_ends_only_the_motion_whose_rows_were_asked_for(plain: Bench) -> None:
    one_motion_far_away(plain, 1, 10)
    one_motion_far_away(plain, 2, 50)
    assert [query.first_row for _, query, *_ in plain.wires.queries] == [10, 50]
    refuse(plain, 0)
    assert (why(plain, 1), why(plain, 2)) == ("gone", "busy")


def test_a_refusal_that_answers_no_question_of_this_process_ends_no_motion(plain: Bench) -> None:
    one_motion_far_away(plain, 1, 10)
    key_, asked, sink, tag = plain.wires.queries[0]
    plain.wires.queries.append((key_, asked, sink, tag + 1000))
    refuse(plain, 1)
    refuse(plain, 0, serial=NEXT)
    assert why(plain, 1) == "busy"
    # The question is over all the same: refused by another module, it is asked anew in its time.
    for _ in range(500):
        plain.host.cycle()
    refuse(plain, -1)
    assert why(plain, 1) == "gone"


# ------------------------------------------------------------------ anything at all

NUMBERS = st.one_of(
    st.integers(-(2**63), 2**64 - 1),
    st.sampled_from([0, 1, 5, ROWS, 100_000, 2**31, 2**62, 2**63 - 1, -(2**63)]),
)
FLOATS = st.one_of(
    st.floats(), st.sampled_from([0.0, 1e19, -1e19, 2.7e18, -2.7e18, 0.1, -0.1, 1e-3, 500.0, 12.0])
)
SOME_ROWS = st.integers(0, ROWS)
FEW_MOTIONS = st.integers(1, 3)
# Mostly what might be kept, so that what follows from keeping it comes about.
RANGES = st.builds(
    rows, st.sampled_from([FAR, "J4", "J5"]), SOME_ROWS, SOME_ROWS | NUMBERS, st.just(BOOT) | NUMBERS
)
COLLECTING = st.builds(
    lambda own, ranges, number: collecting(own, *ranges, motion_id=number),
    st.just(rows(OWN)) | st.builds(rows, st.just(OWN), SOME_ROWS, SOME_ROWS, st.just(BOOT) | NUMBERS),
    st.lists(RANGES, max_size=3, unique_by=lambda wanted: wanted["serial"]) | st.lists(RANGES, max_size=70),
    FEW_MOTIONS | NUMBERS,
)
# So large that they matter, so small that they are computed with.
TIMES = st.integers(-(10**9), 10**10) | st.integers(-MAX_TIME_NS, MAX_TIME_NS)
OFFSETS = st.floats(-1e9, 1e9) | st.floats(-MAX_OFFSET_NS, MAX_OFFSET_NS)
CLOCK = st.fixed_dictionaries(
    {"origin_ns": TIMES | NUMBERS, "offset_ns": OFFSETS | FLOATS, "drift": st.floats(-0.1, 0.1)}
)
SPAN = st.fixed_dictionaries(
    {
        "motion_id": st.just(1) | FEW_MOTIONS,
        "start_ns": TIMES | NUMBERS,
        "end_ns": TIMES | NUMBERS,
        "first_ns": TIMES | NUMBERS,
        "samples": st.integers(1, 400) | st.integers(1, 65_536),
    }
)


def changed(of: dict[str, Any], by: st.SearchStrategy[dict[str, Any]]) -> st.SearchStrategy[dict[str, Any]]:
    """Return a good part of a message with some of its fields as they come."""
    names = st.sets(st.sampled_from(sorted(of)), min_size=1, max_size=2)
    return st.builds(lambda any_, which: {**of, **{n: any_[n] for n in which if n in any_}}, by, names)


GOOD = asking()
CHAIN = st.fixed_dictionaries(
    {
        "serials": st.lists(st.sampled_from([OWN, NEXT, FAR]), min_size=1, max_size=3),
        "parent": st.lists(st.integers(-1, 3), min_size=1, max_size=3),
        "reversed": st.lists(st.booleans(), min_size=2, max_size=2),
        "geometry": st.lists(FLOATS, min_size=44, max_size=44).map(lambda v: struct.pack("<44d", *v)),
        "gravity_m_s2": st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3),
    }
)
ASKING = changed(
    GOOD,
    st.fixed_dictionaries(
        {
            "chain": changed(GOOD["chain"], CHAIN),
            "clocks": st.lists(changed(GOOD["clocks"][0], CLOCK), min_size=1, max_size=2),
            "motions": st.lists(changed(GOOD["motions"][0], SPAN), min_size=1, max_size=3),
            "step_ns": st.integers(1_000_000, 1_000_000_000),
            "cutoff_hz": st.floats(0.01, 125.0) | FLOATS,
            "offset": NUMBERS,
        }
    ),
)


def is_answer(payload: bytes) -> bool:
    """Return whether an answer is one that is readable."""
    kinds: tuple[Callable[[], object], ...] = (
        lambda: decode(Ack, payload),
        lambda: decode(Information, payload, MAX_MESSAGE_BYTES),
    )
    for kind in kinds:
        try:
            kind()
        except WireError:
            continue
        return True
    return False


@pytest.fixture(scope="module")
def lasting() -> Bench:
    """A process that is asked one thing after another, as the agents of a robot are."""
    return Bench(InlineWorker())


@settings(max_examples=300, deadline=None, derandomize=True)
@given(message=COLLECTING)
def test_no_demand_to_keep_rows_stops_the_ticks(lasting: Bench, message: dict[str, Any]) -> None:
    assert is_answer(lasting.ask(Leaf.COLLECT, message))
    lasting.host.cycle()


@settings(max_examples=300, deadline=None, derandomize=True)
@given(message=ASKING)
def test_no_question_about_torques_stops_the_ticks(lasting: Bench, message: dict[str, Any]) -> None:
    # Rows that are still kept: the bench has gone on.
    end = lasting.host.modules[0].firmware.history.next_row
    lasting.ask(Leaf.COLLECT, collecting(rows(OWN, 0, end - 1), rows(NEXT, 0, end - 1)))
    assert is_answer(lasting.ask(Leaf.INFORMATION, message))
    assert is_answer(lasting.ask(Leaf.INFORMATION, message))
