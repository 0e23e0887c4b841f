"""What a feed shows of a session: every published row, once and at its time, and the poses."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.recording.recording import Entry, Recording
from coordinator.viewer.feed import ROWS_PERIOD_NS, ViewerFeed
from module_agent.model.chain import Chain
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Message

MS = 1_000_000
# The module booted this long before the session began.
AHEAD_NS = 7_000 * MS


class Shown:
    """A viewer that records its calls."""

    def __init__(self) -> None:
        self.rows_of: dict[str, list[tuple[int, float]]] = {}
        self.calls: list[str] = []
        self.turned: list[tuple[int, list[float]]] = []

    def rows(self, serial: str, t_ns: np.ndarray, rows: np.ndarray) -> None:
        self.calls.append("rows")
        shown = zip(t_ns.tolist(), rows["position_rad"].tolist(), strict=True)
        self.rows_of.setdefault(serial, []).extend(shown)

    def poses(self, t_ns: Any, q_rad: Any, serials: Any) -> None:
        self.calls.append("poses")
        self.turned += [(int(t), list(q)) for t, q in zip(t_ns, q_rad, strict=True)]

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: self.calls.append(name)


class Rig:
    """A recording and the feed of a viewer, called as in a run."""

    def __init__(self, wire: SimpleNamespace):
        self.wire = wire
        self.recording = Recording()
        self.viewer: Any = Shown()
        self.feed = ViewerFeed(self.viewer, self.recording)

    def receive(self, entry: Entry) -> None:
        message = self.recording.add(entry)
        assert isinstance(message, Message)
        self.feed.on_message(entry, message)

    def connect(self, *serials: str) -> None:
        """Connect modules, with a round trip that tells how far their clocks are ahead."""
        for serial in serials:
            self.receive(self.wire.request(Leaf.STATUS, self.wire.ask(serial, seq=4), 0))
            answer = self.wire.status(serial, re=4, t_ns=AHEAD_NS)
            self.receive(self.wire.reply(Leaf.STATUS, answer, 0))
        self.feed.connected(dict.fromkeys(serials, "X5-4"), 0)

    def publish(self, first: int, serial: str = "A", late_ns: int = 0) -> None:
        """Publish five rows, which arrive 2 ms and `late_ns` after the last of them."""
        block = self.wire.rows(first, 5)
        block["t_ns"] += AHEAD_NS
        arrival_ns = 4 * MS * (first + 4) + 2 * MS + late_ns
        feedback = self.wire.feedback(serial, first=first, rows=block)
        self.receive(self.wire.publication(Leaf.FEEDBACK, feedback, arrival_ns))


@pytest.fixture
def rig(wire: SimpleNamespace) -> Rig:
    return Rig(wire)


def _fit(chain: Chain) -> ChainEstimate:
    count = len(chain.serials)
    nothing = np.zeros((6 * count,) * 2)
    return ChainEstimate(chain, nothing, nothing[:, :0], 0, 1.0)


def test_a_link_of_unknown_length_is_shown_as_unknown_and_the_root_as_exact(rig: Rig) -> None:
    rig.connect("A", "B")
    home = np.tile(np.eye(4), (2, 1, 1))
    home[1, :3, 3] = [0.2, 0.0, 0.05]
    axes = np.tile([0.0, 0.0, 1.0], (2, 1))
    arm = Chain(("A", "B"), (-1, 0), (False, False), axes, home[:, :3, 3], home, np.array([0.0, -9.8, 0.0]))
    outward = np.zeros((12, 1))
    outward[9] = 1.0
    fit = ChainEstimate(arm, np.zeros((12, 12)), outward, 0, 1.0)
    shown: list[list[float]] = []
    rig.viewer.chain = lambda now_ns, chain, sigma_m, covariance: shown.append(sigma_m)
    rig.feed.chain(0, fit)
    assert shown == [[0.0, np.inf]]


def _rows(*numbers: int) -> list[tuple[int, float]]:
    return [(4 * MS * number, float(number)) for number in numbers]


def test_every_row_is_shown_once_at_the_time_of_its_own_clock(rig: Rig) -> None:
    rig.connect("A", "B")
    for first in range(0, 2000, 5):
        rig.publish(first, "A")
        rig.publish(first, "B")
    rig.feed.close()
    assert rig.viewer.rows_of == {"A": _rows(*range(2000)), "B": _rows(*range(2000))}


def test_late_rows_are_shown_when_they_arrive_and_lost_ones_are_not(rig: Rig) -> None:
    rig.connect("A")
    for first in (0, 10, 5, 15, 25, 30):
        rig.publish(first)
    # Far behind whatever is gathered together.
    rig.publish(5000)
    rig.publish(20, late_ns=25_000 * MS)
    rig.feed.close()
    numbers = [*range(5), *range(10, 15), *range(5, 10), *range(15, 20), *range(25, 35)]
    assert rig.viewer.rows_of["A"] == _rows(*numbers, *range(5000, 5005), *range(20, 25))


def test_rows_are_shown_ten_times_a_second(rig: Rig) -> None:
    rig.connect("A", "B")
    for first in range(0, 5000, 5):
        rig.publish(first, "A")
        rig.publish(first, "B")
    # 20 s of messages every 20 ms, of two modules; each call has the rows since the last one.
    expected = 2 * 20_000 * MS // ROWS_PERIOD_NS
    assert abs(rig.viewer.calls.count("rows") - expected) <= 2


def test_rows_of_a_module_that_fell_silent_are_shown_with_those_of_the_others(rig: Rig) -> None:
    rig.connect("A", "B")
    rig.publish(0, "A")
    for first in range(0, 2000, 5):
        rig.publish(first, "B")
    assert rig.viewer.rows_of["A"] == _rows(*range(5))


def test_nothing_is_shown_of_a_module_whose_clock_is_not_known(rig: Rig) -> None:
    rig.feed.connected({"A": "X5-4"}, 0)
    for first in range(0, 2000, 5):
        rig.publish(first)
    rig.feed.close()
    assert rig.viewer.rows_of == {}


def test_the_robot_turns_thirty_times_a_second_as_its_newest_rows_say(rig: Rig) -> None:
    rig.connect("A")
    arm = Chain(("A",), (-1,), (False,), np.eye(3)[:1], np.zeros((1, 3)), np.eye(4)[None], np.eye(3)[2])
    fit = _fit(arm)
    rig.feed.chain(0, fit)
    for first in range(0, 1000, 5):
        rig.publish(first)
    rig.feed.close()
    times = np.array([t_ns for t_ns, _ in rig.viewer.turned])
    # Messages come every 20 ms, so that every second one is the first after 33 ms.
    np.testing.assert_array_equal(np.diff(times), 40 * MS)
    assert times[-1] > 3_900 * MS
    assert [q for _, q in rig.viewer.turned] == [[round((t - 2 * MS) / (4 * MS))] for t in times.tolist()]
    assert rig.viewer.calls[-1] == "close"


def test_notes_are_shown_at_their_time_in_the_session_from_its_beginning_on(rig: Rig) -> None:
    noted = list[tuple[int, str]]()
    rig.viewer.note = lambda *line: noted.append(line)
    rig.feed.note(7, "before there is a session")
    rig.feed.begin(10)
    rig.feed.note(25, "going on without B")
    assert noted == [(15, "going on without B")]
