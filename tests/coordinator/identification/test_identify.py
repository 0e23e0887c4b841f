"""From a recording to the robot: what must not matter does not, and what is missing is named."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from coordinator.identification.identified import IdentificationError
from coordinator.identification.identify import identify, identify_kinematics, write_held_out
from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import JOURNAL_TOPIC, Entry, Recording
from coordinator.recording.session_file import read_session
from coordinator.session.run import write_outputs
from module_agent.wire.keys import Leaf, parse
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain, true_inertia

BASE, TIP = "X-00009", "X-00010"
# One process makes the recording that all tests here work on.
pytestmark = pytest.mark.xdist_group("identify")


@pytest.fixture(scope="module")
def entries(tmp_path_factory: pytest.TempPathFactory) -> list[Entry]:
    """All entries of one run, filled in by the first test that has a rig to make it with."""
    return []


@pytest.fixture
def run(entries: list[Entry], rigs: Callable[..., Any], quick_plan: Any, tmp_path: Path) -> list[Entry]:
    """A run on a one-joint arm that swings in a vertical plane, dynamics included; made once."""
    if not entries:
        plan = quick_plan.model_copy(update={"dynamics": True, "dynamic_repeats": 2})
        rigs("thesis_171_vertical", "lan", 3).session(tmp_path / "run", plan)
        entries.extend(read_session(tmp_path / "run" / "session.mcap"))
    return list(entries)


def _recorded(entries: Iterable[Entry]) -> Recording:
    recording = Recording()
    for entry in entries:
        recording.add(entry)
    return recording


def _event(entry: Entry) -> JournalEvent | None:
    return JournalEvent.model_validate_json(entry.payload) if entry.kind == "journal" else None


def _without(entries: list[Entry], dropped: Callable[[JournalEvent], bool]) -> list[Entry]:
    return [e for e in entries if (event := _event(e)) is None or not dropped(event)]


def _on(entry: Entry, leaf: Leaf, serial: str) -> bool:
    return entry.kind != "journal" and parse(entry.topic)[1:] == (serial, leaf)


def _explored_at(entries: list[Entry]) -> int:
    (place,) = (i for i, e in enumerate(entries) if (event := _event(e)) and event.what == "explored")
    return place


def test_the_arm_is_identified_and_predicts_held_out_torques(run: list[Entry], tmp_path: Path) -> None:
    identified = identify(_recorded(run))
    topology, fit = identified.kinematics.topology, identified.kinematics.fit
    assert (topology.serials, topology.parent, topology.reversed) == ((BASE, TIP), (-1, 0), (False, False))
    assert fit.link_length_m[1] == pytest.approx(0.171, abs=2e-3)  # see tests/simulation/test_robots
    assert identified.inertia is not None
    assert identified.held_out is not None
    # The base joint carries 0.2 m of arm against gravity: 1 % of its torque; the tip turns nothing.
    assert identified.held_out.error.per_joint[0] < 0.03
    assert identified.result.dynamics is not None
    assert identified.result.dynamics.rank < identified.result.dynamics.parameters
    write_held_out(tmp_path / "held_out.npz", identified.held_out)
    with np.load(tmp_path / "held_out.npz") as file:
        assert sorted(file) == sorted(
            ("serials", "t_ns", "session_ns", "q_rad", "tau_measured_nm", "tau_predicted_nm")
        )
        assert file["t_ns"].shape == file["tau_measured_nm"].shape


def test_the_bodies_in_the_files_are_real_and_predict_as_well(run: list[Entry], tmp_path: Path) -> None:
    identified = identify(_recorded(run))
    assert identified.bodies is not None
    assert identified.bodies.held_out_error is not None
    assert identified.held_out is not None
    assert identified.bodies.held_out_error < identified.held_out.error.overall + 1e-3
    write_outputs(tmp_path, identified)
    assert "nearest real body" not in (tmp_path / "robot.urdf").read_text()
    model = ElementTree.parse(tmp_path / "robot.urdf")
    masses = [float(mass.get("value", "nan")) for mass in model.iter("mass")]
    assert identified.result.dynamics is not None
    assert identified.result.dynamics.bodies is not None
    assert masses == pytest.approx([body.mass_kg for body in identified.result.dynamics.bodies.bodies])
    # Torques show no mass of an arm on one moving joint; what modules weigh is near all the same.
    for mass, true in zip(masses, true_inertia(load_robot("thesis_171_vertical"))[:, 0], strict=True):
        assert 0.3 < mass / true < 3.0


def test_the_result_says_what_is_known_of_every_parameter(run: list[Entry]) -> None:
    dynamics = identify(_recorded(run)).result.dynamics
    assert dynamics is not None
    assert len(dynamics.base_parameters) == dynamics.rank
    assert len(dynamics.identifiability) == dynamics.parameters == 20
    sums = dynamics.base_parameters
    alone = [
        v
        for v in dynamics.identifiability
        if any(sums[place].summary == v.parameter for place in v.base_parameters)
    ]
    assert alone
    for entry in alone:
        # Known by itself: the one sum that it is in is it.
        (place,) = entry.base_parameters
        assert (sums[place].value, sums[place].sigma) == (entry.value, entry.sigma)
        relative = sums[place].relative_sigma
        assert relative is not None
        assert entry.identifiability == ("identified" if relative <= 0.1 else "weak")
    assert {v.serial for v in dynamics.identifiability} == {BASE, TIP}
    assert len(dynamics.summary) == 3


def test_the_axis_of_the_joint_and_gravity_stand_as_in_the_robot(run: list[Entry]) -> None:
    chain = identify_kinematics(_recorded(run)).fit.chain
    truth = true_chain(load_robot("thesis_171_vertical"))
    for estimate, true in ((chain.axis[0], truth.axis[0]), (chain.gravity, truth.gravity)):
        angle = np.arccos(estimate @ true / np.linalg.norm(estimate) / np.linalg.norm(true))
        # The root's accelerometer never turns: its bias of 0.1 m/s^2 tilts gravity by 0.6 deg.
        assert np.degrees(angle) < 1.5


def test_the_same_recording_gives_the_same_result_to_the_last_bit(run: list[Entry]) -> None:
    one, two = (identify(_recorded(run)).result.model_dump_json() for _ in range(2))
    assert one == two


def test_the_order_in_which_feedback_arrived_does_not_matter(run: list[Entry]) -> None:
    feedback = [i for i, e in enumerate(run) if _on(e, Leaf.FEEDBACK, BASE) or _on(e, Leaf.FEEDBACK, TIP)]
    # Topology and chain are identified from what has arrived until then.
    decided = _explored_at(run)
    shuffled = list(run)
    for places in ([i for i in feedback if i < decided], [i for i in feedback if i > decided]):
        for place, taken in zip(places, np.random.default_rng(1).permutation(places).tolist(), strict=True):
            shuffled[place] = run[taken]
    one, two = (identify(_recorded(each)).result for each in (run, shuffled))
    assert one.trace_hash != two.trace_hash
    # What was late counts as lost at first, and shuffled feedback is late.
    same = {"trace_hash": "", "wall_time_s": None, "feedback_losses": []}
    assert one.model_copy(update=same) == two.model_copy(update=same)


def test_a_motion_that_was_done_again_counts_the_last_time_only(run: list[Entry]) -> None:
    event = next(e for e in map(_event, run) if e is not None and e.purpose == "windowed_sine")
    assert event.motion is not None
    spoilt = event.model_copy(update={"motion": event.motion.model_copy(update={"motion_id": 1})})
    first = Entry("journal", JOURNAL_TOPIC, 0, spoilt.encode())
    again, once = (identify_kinematics(_recorded(each)).fit.chain for each in ([first, *run], run))
    # The motions are taken in another order, so that sums round otherwise.
    np.testing.assert_allclose(again.imu_home, once.imu_home, atol=1e-7)


def test_a_motion_from_before_a_module_booted_does_not_count(run: list[Entry]) -> None:
    # Its numbers are those of other rows, here of the rest.
    event, rest = (
        next(e for e in map(_event, run) if e is not None and e.purpose == purpose)
        for purpose in ("windowed_sine", "rest")
    )
    assert rest.motion is not None
    before = event.model_copy(update={"purpose": "repeat", "boot": event.boot + 1, "motion": rest.motion})
    stale = Entry("journal", JOURNAL_TOPIC, 0, before.encode())
    fresh = Entry("journal", JOURNAL_TOPIC, 0, before.model_copy(update={"boot": event.boot}).encode())
    with_stale, with_fresh, once = (
        identify_kinematics(_recorded(each)).fit.chain for each in ([*run, stale], [*run, fresh], run)
    )
    np.testing.assert_array_equal(with_stale.imu_home, once.imu_home)
    assert not np.array_equal(with_fresh.imu_home, once.imu_home)


def test_an_empty_recording_is_an_error() -> None:
    with pytest.raises(IdentificationError, match="no rest was recorded"):
        identify(Recording())


def test_a_joint_that_was_not_explored_is_named(run: list[Entry]) -> None:
    cut = _without(run, lambda e: e.purpose == "windowed_sine" and e.serial == TIP)
    with pytest.raises(IdentificationError, match=f"no exploration of {TIP} was recorded"):
        identify(_recorded(cut))


def test_a_module_without_reported_type_is_named(run: list[Entry]) -> None:
    cut = [e for e in run if not _on(e, Leaf.INFO, TIP)]
    with pytest.raises(IdentificationError, match=f"module {TIP} has not reported its type"):
        identify(_recorded(cut))


def test_a_module_whose_own_estimates_are_lost_is_placed_by_its_feedback(run: list[Entry]) -> None:
    cut = [e for e in run if not _on(e, Leaf.ESTIMATE, TIP)]
    topology = identify_kinematics(_recorded(cut)).topology
    assert (topology.serials, topology.parent, topology.reversed) == ((BASE, TIP), (-1, 0), (False, False))
    assert topology.confidence > 0.99


def test_the_result_says_how_surely_every_module_is_mounted_where_and_how(run: list[Entry]) -> None:
    identified = identify(_recorded(run)).result
    base, tip = identified.topology
    assert (base.serial, base.parent, tip.serial, tip.parent) == (BASE, None, TIP, BASE)
    # One slow motion of the joint beneath is all that tells, and no motion tells more than 1 in 8000.
    assert tip.parent_log_odds is not None
    assert 5.0 < tip.parent_log_odds < 10.0
    assert (base.joint_moved, tip.joint_moved) == (True, True)
    least = min(
        m for part in identified.topology for m in (part.parent_log_odds, part.reversed_log_odds) if m
    )
    assert identified.topology_confidence == pytest.approx(1.0 / (1.0 + np.exp(-least)))


def test_a_module_without_observations_is_excluded_and_named(run: list[Entry]) -> None:
    event = next(e for e in map(_event, run) if e is not None and e.what == "done" and e.step == "rest")
    cut = [
        e
        for e in run
        if not _on(e, Leaf.ESTIMATE, TIP)
        # Rows that the network lost were asked for again.
        and not ((_on(e, Leaf.FEEDBACK, TIP) or _on(e, Leaf.HISTORY, TIP)) and e.t_ns > event.t_ns)
    ]
    identified = identify_kinematics(_recorded(cut))
    assert identified.topology.serials == (BASE,)
    assert any(TIP in text and "left out" in text for text in identified.suspicions)


def test_a_module_without_round_trips_is_an_error_about_its_clock(run: list[Entry]) -> None:
    cut = [e for e in run if e.kind != "request" or parse(e.topic).serial != TIP]
    with pytest.raises(IdentificationError, match="no round trip"):
        identify(_recorded(cut))


def test_too_short_a_rest_is_named_with_what_is_needed(run: list[Entry]) -> None:
    short = []
    for entry in run:
        event = _event(entry)
        if event is not None and event.purpose == "rest" and event.motion is not None:
            motion = event.motion.model_copy(update={"end_row": event.motion.start_row + 3})
            entry = entry._replace(payload=event.model_copy(update={"motion": motion}).encode())
        short.append(entry)
    with pytest.raises(IdentificationError, match="has 3 rows at rest, 10 are needed"):
        identify(_recorded(short))


def test_a_hole_in_a_motion_is_named_and_costs_the_samples_around_it(run: list[Entry]) -> None:
    event = next(e for e in map(_event, run) if e is not None and e.purpose == "windowed_sine")
    assert event.motion is not None
    moved_ns = event.t_ns
    cut = [e for e in run if not (_on(e, Leaf.FEEDBACK, TIP) and 0.4e9 < moved_ns - e.t_ns < 0.9e9)]
    whole, holed = identify_kinematics(_recorded(run)), identify_kinematics(_recorded(cut))
    assert any("hole" in note and TIP in note for note in holed.notes), holed.notes
    assert not any("hole" in note for note in whole.notes)
    length, sigma = holed.fit.link_length_m[1], holed.fit.link_length_sigma_m[1]
    assert abs(length - whole.fit.link_length_m[1]) < 3.0 * sigma
    # Half a second of one motion of several is lost: less is known, but not by much.
    assert whole.fit.link_length_sigma_m[1] < 1.05 * sigma < 3.0 * whole.fit.link_length_sigma_m[1]


def test_without_dynamic_motions_there_is_no_inertia_and_no_guess_at_it(run: list[Entry]) -> None:
    identified = identify(_recorded(_without(run, lambda e: e.purpose in ("dynamic", "held_out"))))
    assert identified.inertia is None
    assert identified.held_out is None
    assert identified.result.dynamics is None


def test_topology_and_chain_are_those_of_the_exploration(run: list[Entry]) -> None:
    """What is recorded after it, the dynamic motions and further round trips, moves the clocks alone."""
    place = _explored_at(run)
    then, now = identify_kinematics(_recorded(run[: place + 1])), identify_kinematics(_recorded(run))
    assert now.topology == then.topology
    np.testing.assert_array_equal(now.fit.chain.imu_home, then.fit.chain.imu_home)
    # The session went on for seconds: the later round trips count.
    assert any(now.clocks[serial] != then.clocks[serial] for serial in (BASE, TIP))


def test_a_chain_that_is_known_already_is_not_computed_again(run: list[Entry]) -> None:
    recording = _recorded(run)
    assert recording.explored is not None
    explored = identify_kinematics(recording.explored)
    result = identify(recording, explored=explored)
    assert result.kinematics.refinement is explored.refinement
    assert result.result.model_dump_json() == identify(_recorded(run)).result.model_dump_json()


def test_a_copy_of_the_exploration_does_not_grow_with_the_recording(run: list[Entry]) -> None:
    place = _explored_at(run)
    recording = _recorded(run[: place + 1])
    so_far = recording.explored
    assert so_far is not None
    before = (so_far.trace_hash, {s: (m.rows.end_row, len(m.round_trips)) for s, m in so_far.modules.items()})
    for entry in run[place + 1 :]:
        recording.add(entry)
    after = (so_far.trace_hash, {s: (m.rows.end_row, len(m.round_trips)) for s, m in so_far.modules.items()})
    assert before == after
    assert recording.trace_hash != so_far.trace_hash


def test_a_recording_without_the_event_is_identified_whole(run: list[Entry]) -> None:
    """Recordings of earlier versions do not have it; the results differ by the later round trips alone."""
    older = identify_kinematics(_recorded(_without(run, lambda e: e.what == "explored"))).fit
    newer = identify_kinematics(_recorded(run)).fit
    assert not np.array_equal(older.chain.imu_home, newer.chain.imu_home)
    apart = np.abs(older.link_length_m - newer.link_length_m)[1:]
    assert (apart < 0.1 * newer.link_length_sigma_m[1:]).all()


def test_a_session_that_is_resumed_explores_anew(run: list[Entry]) -> None:
    session = next(e for e in run if (event := _event(e)) is not None and event.what == "session")
    assert _recorded([*run, session]).explored is None


def test_an_exploration_whose_motions_changed_since_is_identified_again(run: list[Entry]) -> None:
    event = next(e for e in map(_event, run) if e is not None and e.purpose == "windowed_sine")
    again = Entry("journal", JOURNAL_TOPIC, 0, event.model_copy(update={"purpose": "repeat"}).encode())
    with_more, once = (identify_kinematics(_recorded(each)).fit.chain for each in ([*run, again], run))
    assert not np.array_equal(with_more.imu_home, once.imu_home)
