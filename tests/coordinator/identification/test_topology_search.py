"""Who moved with whom out of a recording: all that was seen counts, what is missing is named, not guessed."""

from collections.abc import Collection
from types import SimpleNamespace

import numpy as np
import pytest

from coordinator.identification.topology_observations import observe, slow_motions
from coordinator.identification.topology_search import doubtful_motions, search_topology
from coordinator.recording.recording import Recording
from coordinator.topology.topology import TopologyError
from module_agent.wire.feedback_rows import ROW
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import ConstantMotion, Rest

SERIALS = ("A", "B", "C")  # a chain
STEP_NS = 4_000_000
ROWS = 2000
SLOW = ConstantMotion(velocity_rad_s=1.0, duration_s=0.75)
# Rows of the motions; A moves a second time.
REST, MOVES = (0, 100), {"A": (200, 460), "B": (600, 860), "C": (1000, 1260)}
AGAIN = (1400, 1660)
NOISE_RAD_S, OFFSET_RAD_S = 0.01, 0.2


def _rate(start: int, end: int) -> np.ndarray:
    t = np.arange(ROWS)
    return np.clip(np.minimum(t - start, end - t) / 40.0, 0.0, 1.0)


def _feedback(serial: str, joint_rate: dict[str, np.ndarray], seed: int) -> np.ndarray:
    """A module of a chain feels all joints before it, each about an axis of its own."""
    rng, before = np.random.default_rng(seed), SERIALS[: SERIALS.index(serial)]
    rows = np.zeros(ROWS, dtype=ROW)
    rows["t_ns"] = rows["imu_t_ns"] = STEP_NS * np.arange(ROWS)
    rows["position_rad"] = np.cumsum(joint_rate[serial]) * STEP_NS / 1e9
    gyro = OFFSET_RAD_S + NOISE_RAD_S * rng.normal(size=(ROWS, 3))
    for n, joint in enumerate(before):
        gyro[:, n] += joint_rate[joint]
    rows["gyro_rad_s"] = gyro
    return rows


def recorded(
    wire: SimpleNamespace,
    stuck: Collection[str] = (),
    mute_from: dict[str, int] | None = None,
    again: bool = False,
    spoilt: bool = False,
) -> Recording:
    """A session of a chain of three. `mute_from`: the row from which on a module's feedback is missing.

    again: A moves twice; spoilt: C's IMU turns along the other way in its first motion.
    """
    recording = Recording()
    rate = {s: np.zeros(ROWS) if s in stuck else _rate(*MOVES[s]) for s in SERIALS}
    if again:
        rate["A"] = rate["A"] + _rate(*AGAIN)
    for n, serial in enumerate(SERIALS):
        for seq in range(1, 8):
            at = 1000 * seq * STEP_NS // 7
            recording.add(wire.request(Leaf.STATUS, wire.ask(serial, seq), at))
            recording.add(wire.reply(Leaf.STATUS, wire.status(serial, re=seq, t_ns=at), at))
        rows = _feedback(serial, rate, n)
        if spoilt and serial == "C":
            rows["gyro_rad_s"][: AGAIN[0], 0] -= rate["A"][: AGAIN[0]].astype(np.float32)
        end = (mute_from or {}).get(serial, ROWS)
        for first in range(0, end, 500):
            block = rows[first : min(first + 500, end)]
            recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(serial, first=first, rows=block)))
    for number, serial in enumerate(SERIALS, 1):
        rest = wire.record(number, Rest(duration_s=0.4), *REST)
        recording.add(wire.journal("motion", serial=serial, purpose="rest", motion=rest))
    moves = [*MOVES.items(), *([("A", AGAIN)] if again else [])]
    for number, (serial, span) in enumerate(moves, 10):
        motion = wire.record(number, SLOW, *span)
        recording.add(wire.journal("motion", serial=serial, boot=1, purpose="constant", motion=motion))
    return recording


def test_the_feedback_alone_tells_the_chain(wire: SimpleNamespace) -> None:
    recording = recorded(wire)
    seen = observe(recording, SERIALS)
    assert (dict(seen.unmoved), seen.blind) == ({}, ())
    for (joint, observer), one in seen.observations.items():
        carried = SERIALS.index(joint) < SERIALS.index(observer)
        assert one.moved == carried
        assert one.rate_ratio == pytest.approx(float(carried), abs=0.01)
    found = search_topology(recording, SERIALS)
    assert (found.topology.serials, found.topology.parent) == (SERIALS, (-1, 0, 1))
    assert found.notes == ()
    assert doubtful_motions(recording) == ()


def test_a_joint_that_is_stuck_is_a_leaf_and_named_with_how_little_it_moved(wire: SimpleNamespace) -> None:
    found = search_topology(recorded(wire, stuck=["B"]), SERIALS)
    assert found.topology.parent == (-1, 0, 0)
    assert found.topology.unmoved == ("B",)
    (note,) = found.notes
    assert "joint B did not move (it turned at only" in note


def test_where_no_joint_moved_that_is_what_is_said(wire: SimpleNamespace) -> None:
    with pytest.raises(TopologyError, match=r"no module saw any motion.*joint A: it turned at only"):
        search_topology(recorded(wire, stuck=SERIALS), SERIALS)


def test_a_module_that_falls_silent_before_all_motions_is_left_out(wire: SimpleNamespace) -> None:
    found = search_topology(recorded(wire, mute_from={"C": 150}), SERIALS)
    assert (found.topology.serials, found.topology.parent) == (("A", "B"), (-1, 0))
    assert found.notes[0].startswith("C saw no motion at all and is left out")


def test_a_module_that_falls_silent_in_between_has_seen_what_it_has_seen(wire: SimpleNamespace) -> None:
    """C saw joint A, and is silent when B moves: whether it is on A or on B, nobody knows."""
    recording = recorded(wire, mute_from={"C": 500})
    seen = observe(recording, SERIALS)
    assert ("A", "C") in seen.observations
    assert ("B", "C") not in seen.observations
    with pytest.raises(TopologyError, match="C saw nothing of joint B"):
        search_topology(recording, SERIALS)
    motions = doubtful_motions(recording)
    assert "B" in [motion.joint for motion in motions]


def test_a_modules_own_finding_stands_in_for_its_missing_feedback(wire: SimpleNamespace) -> None:
    recording = recorded(wire, mute_from={"C": 500})
    found = wire.estimate("B", "C", ids=(11,), moved=True, rate_ratio=0.97)
    recording.add(wire.publication(Leaf.ESTIMATE, found))
    topology = search_topology(recording, SERIALS).topology
    assert topology.parent == (-1, 0, 1)
    # It is believed less than the feedback would be.
    assert topology.parent_log_odds[2] < topology.parent_log_odds[1]


def test_a_module_that_finds_otherwise_than_its_feedback_makes_less_certain(wire: SimpleNamespace) -> None:
    recording = recorded(wire)
    before = observe(recording, SERIALS).observations["B", "C"]
    recording.add(wire.publication(Leaf.ESTIMATE, wire.estimate("B", "C", ids=(11,), rate_ratio=0.4)))
    after = observe(recording, SERIALS).observations["B", "C"]
    assert after.moved
    assert after.log_odds < before.log_odds - 3.0


def test_a_motion_done_twice_counts_twice_and_outvotes_nothing_that_agrees(wire: SimpleNamespace) -> None:
    once, twice = (observe(recorded(wire, again=a), SERIALS).observations["A", "C"] for a in (False, True))
    assert twice.log_odds == pytest.approx(2.0 * once.log_odds, rel=0.05)
    assert len(slow_motions(recorded(wire, again=True), "A")) == 2


def test_a_motion_that_contradicts_its_repetition_is_a_toss_up_and_asked_for_again(
    wire: SimpleNamespace,
) -> None:
    recording = recorded(wire, again=True, spoilt=True)
    assert abs(observe(recording, SERIALS).observations["A", "C"].log_odds) < 1.0
    # C moves with B, and B with A: so A carries C, whatever that motion seemed to say.
    assert search_topology(recording, SERIALS).topology.parent == (-1, 0, 1)


def test_motions_of_an_earlier_boot_do_not_count(wire: SimpleNamespace) -> None:
    recording = recorded(wire)
    assert len(slow_motions(recording, "A")) == 1
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback("A", boot=2, first=0, count=5)))
    assert slow_motions(recording, "A") == []
