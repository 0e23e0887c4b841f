"""Which joint moved which IMU: all observations count, missing ones are named and not guessed."""

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
    """Gyros of a chain: every joint moves the modules beyond it, each about its own axis."""
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
    silent_from: dict[str, int] | None = None,
    again: bool = False,
    spoilt: bool = False,
) -> Recording:
    """A session of a chain of three. `silent_from`: the row from which on a module's feedback is missing.

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
        end = (silent_from or {}).get(serial, ROWS)
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


def test_feedback_alone_determines_the_chain(wire: SimpleNamespace) -> None:
    recording = recorded(wire)
    observed = observe(recording, SERIALS)
    assert (dict(observed.unmoved), observed.silent) == ({}, ())
    for (joint, observer), one in observed.observations.items():
        carried = SERIALS.index(joint) < SERIALS.index(observer)
        assert one.moved == carried
        assert one.rate_ratio == pytest.approx(float(carried), abs=0.01)
    result = search_topology(recording, SERIALS)
    assert (result.topology.serials, result.topology.parent) == (SERIALS, (-1, 0, 1))
    assert result.notes == ()
    assert doubtful_motions(recording) == ()


def test_a_joint_that_is_stuck_is_a_leaf_and_named_with_how_little_it_moved(wire: SimpleNamespace) -> None:
    result = search_topology(recorded(wire, stuck=["B"]), SERIALS)
    assert result.topology.parent == (-1, 0, 0)
    assert result.topology.unmoved == ("B",)
    (note,) = result.notes
    assert result.missing == (note,)
    assert "joint B did not move (it turned at only" in note


def test_without_any_moved_joint_the_error_says_so(wire: SimpleNamespace) -> None:
    with pytest.raises(TopologyError, match=r"no module observed any motion.*joint A: it turned at only"):
        search_topology(recorded(wire, stuck=SERIALS), SERIALS)


def test_without_any_heard_module_no_motion_is_repeated(wire: SimpleNamespace) -> None:
    recording = recorded(wire, silent_from=dict.fromkeys(SERIALS, 150))
    assert doubtful_motions(recording) == ()
    with pytest.raises(TopologyError, match="no module observed any motion"):
        search_topology(recording, SERIALS)


def test_a_module_that_falls_silent_before_all_motions_is_excluded(wire: SimpleNamespace) -> None:
    result = search_topology(recorded(wire, silent_from={"C": 150}), SERIALS)
    assert (result.topology.serials, result.topology.parent) == (("A", "B"), (-1, 0))
    assert result.missing == (result.notes[0],)
    assert result.missing[0].startswith("C observed no motion and is left out")


def test_observations_before_a_module_falls_silent_count(wire: SimpleNamespace) -> None:
    """C observes joint A and is silent when B moves: it may be on A or on B."""
    recording = recorded(wire, silent_from={"C": 500})
    observed = observe(recording, SERIALS)
    assert ("A", "C") in observed.observations
    assert ("B", "C") not in observed.observations
    with pytest.raises(TopologyError, match="C saw nothing of joint B"):
        search_topology(recording, SERIALS)
    motions = doubtful_motions(recording)
    assert "B" in [motion.joint for motion in motions]


def test_a_modules_own_estimate_replaces_its_missing_feedback(wire: SimpleNamespace) -> None:
    recording = recorded(wire, silent_from={"C": 500})
    result = wire.estimate("B", "C", ids=(11,), moved=True, rate_ratio=0.97)
    recording.add(wire.publication(Leaf.ESTIMATE, result))
    topology = search_topology(recording, SERIALS).topology
    assert topology.parent == (-1, 0, 1)
    # It is believed less than the feedback would be.
    assert topology.parent_log_odds[2] < topology.parent_log_odds[1]


def test_an_own_estimate_that_differs_from_the_feedback_reduces_the_certainty(wire: SimpleNamespace) -> None:
    recording = recorded(wire)
    before = observe(recording, SERIALS).observations["B", "C"]
    recording.add(wire.publication(Leaf.ESTIMATE, wire.estimate("B", "C", ids=(11,), rate_ratio=0.4)))
    after = observe(recording, SERIALS).observations["B", "C"]
    assert after.moved
    assert after.log_odds < before.log_odds - 3.0


def test_a_repeated_motion_that_agrees_counts_twice(wire: SimpleNamespace) -> None:
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
