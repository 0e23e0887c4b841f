"""Recordings with altered sensors, made by a virtual run: what is wrong is named, or the claim covers it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.identification.identified import IdentificationError, Kinematics
from coordinator.identification.identify import identify, identify_kinematics
from coordinator.identification.robot_refinement import refine_checked
from coordinator.recording.journal import JournalEvent, exclusion_event
from coordinator.recording.recording import Entry, Recording
from coordinator.recording.session_file import read_session
from coordinator.synchronisation.motion_windows import unbroken_windows
from module_agent.model.errors import EXIT_SUSPECT
from module_agent.wire.codec import decode, encode
from module_agent.wire.feedback_rows import ROW, Rows
from module_agent.wire.keys import Leaf, parse
from module_agent.wire.messages import Feedback, Info
from sim.benchmark.sick_recordings import Alteration as Alterations
from sim.benchmark.sick_recordings import (
    dead,
    jumped,
    leaping_clock,
    multiplied,
    not_a_number,
    saturated,
    silent,
    stuck,
)
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.scoring.chain_score import link_length_m

YAW, LIFT, ELBOW = "shoulder-yaw", "shoulder-lift", "elbow"
ENCODER = ("position_rad", "velocity_rad_s", "position_command_rad", "velocity_command_rad_s")
Alteration = Callable[[str, int, Rows], None]
# One process makes the recording that all tests here alter.
pytestmark = pytest.mark.xdist_group("altered")


@pytest.fixture(scope="module")
def entries() -> list[Entry]:
    return []


@pytest.fixture
def run(entries: list[Entry], rigs: Callable[..., Any], quick_plan: Any, tmp_path: Path) -> list[Entry]:
    """A run of the kit arm of three joints with calibrated IMUs; made once."""
    if not entries:
        plan = quick_plan.model_copy(update={"imu": "calibrated"})
        rigs("a2085_03", "lan", 3, noise="x5").session(tmp_path / "run", plan)
        entries.extend(read_session(tmp_path / "run" / "session.mcap"))
    return list(entries)


def _altered(entries: list[Entry], alter: Alteration) -> Recording:
    """The recording with the rows of every feedback as `alter(serial, first row, rows)` leaves them."""
    recording = Recording()
    for entry in entries:
        leaf = None if entry.kind in ("journal", "request") else parse(entry.topic).leaf
        if leaf in (Leaf.FEEDBACK, Leaf.HISTORY):
            message = decode(Feedback, entry.payload)
            rows = np.frombuffer(message.rows, ROW).copy()
            alter(message.serial, message.first_row, rows)
            message = message.model_copy(update={"rows": rows.tobytes()})
            entry = entry._replace(payload=encode(message))
        recording.add(entry)
    return recording


def _backwards(wrong: str, fields: tuple[str, ...]) -> Alteration:
    def alter(serial: str, first: int, rows: Rows) -> None:
        if serial == wrong:
            for field in fields:
                rows[field] *= -1.0

    return alter


def test_a_healthy_robot_has_no_findings(run: list[Entry]) -> None:
    kinematics = identify_kinematics(_altered(run, lambda *_: None))
    assert kinematics.findings == ()


@pytest.mark.parametrize("wrong", [YAW, LIFT, ELBOW])
def test_an_encoder_that_runs_against_its_command_is_refused_by_name(run: list[Entry], wrong: str) -> None:
    recording = _altered(run, _backwards(wrong, ENCODER[:2]))
    with pytest.raises(IdentificationError, match=rf"{wrong}: its encoder turned by -.* counts backwards"):
        identify_kinematics(recording)


# The yaw axis is along gravity, which other IMUs see; the lift axis is across gravity and yaw: there only
# its own motor and effort are left.
@pytest.mark.parametrize(
    ("wrong", "what"),
    [(YAW, "the encoder's sign is -1"), (LIFT, "its motor's speed over its joint's is -1")],
)
def test_a_joint_that_counts_backwards_is_refused_by_name(run: list[Entry], wrong: str, what: str) -> None:
    with pytest.raises(IdentificationError, match=rf"{wrong}: {what}"):
        identify_kinematics(_altered(run, _backwards(wrong, ENCODER)))


def test_exchanged_encoders_are_refused_by_name(run: list[Entry]) -> None:
    tracks: dict[tuple[str, int], Rows] = {}

    def keep(serial: str, first: int, rows: Rows) -> None:
        tracks.update({(serial, first + n): row for n, row in enumerate(rows)})

    def exchange(serial: str, first: int, rows: Rows) -> None:
        other = {YAW: ELBOW, ELBOW: YAW}.get(serial)
        for n in range(len(rows)):
            if other is not None and (other, first + n) in tracks:
                for field in ("position_rad", "velocity_rad_s"):
                    rows[field][n] = tracks[other, first + n][field]

    _altered(run, keep)
    with pytest.raises(IdentificationError, match=rf"encoders of {ELBOW} and {YAW} are exchanged"):
        identify_kinematics(_altered(run, exchange))


def _scaled(wrong: str, factor: float) -> Alteration:
    def alter(serial: str, first: int, rows: Rows) -> None:
        if serial == wrong:
            for field in ENCODER[:2]:
                rows[field] *= factor

    return alter


def _covered(kinematics: Kinematics) -> None:
    truth = true_chain(load_robot("a2085_03"))
    for child, serial in enumerate(kinematics.topology.serials[1:], 1):
        error_m = kinematics.fit.link_length_m[child] - link_length_m(truth, truth.serials.index(serial))
        assert abs(error_m) < 3.0 * kinematics.fit.link_length_sigma_m[child]


@pytest.mark.parametrize("wrong", [YAW, LIFT])
def test_an_encoder_with_a_wrong_scale_is_named_and_its_scale_estimated(run: list[Entry], wrong: str) -> None:
    kinematics = identify_kinematics(_altered(run, _scaled(wrong, 1.01)))
    (finding,) = kinematics.findings
    assert (finding.serial, finding.measured) == (wrong, pytest.approx(1.01, abs=1e-3))
    _covered(kinematics)


def test_a_leafs_encoder_with_a_wrong_scale_is_named_by_its_motor(run: list[Entry]) -> None:
    kinematics = identify_kinematics(_altered(run, _scaled(ELBOW, 1.01)))
    (finding,) = kinematics.findings
    assert (finding.serial, finding.measured) == (ELBOW, pytest.approx(762.2 / 1.01, rel=2e-3))
    _covered(kinematics)


def test_a_vertical_joints_scale_is_free_where_gyros_do_not_tell_it(
    run: list[Entry], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Gravity does not turn about the axis, and the scales of gyros as delivered are good to a percent.
    delivered = [
        entry._replace(payload=entry.payload.replace(b'"calibrated"', b'"uncalibrated"'))
        if entry.kind == "journal"
        else entry
        for entry in run
    ]
    free: list[tuple[int, ...]] = []

    def checked(*of_robot: Any) -> Any:
        refined, suspects = refine_checked(*of_robot)
        free.append(suspects.encoders)
        return refined, suspects

    monkeypatch.setattr("coordinator.identification.identify.refine_checked", checked)
    kinematics = identify_kinematics(_altered(delivered, _scaled(YAW, 1.01)))
    assert [finding.serial for finding in kinematics.findings] == [YAW]
    yaw = kinematics.topology.serials.index(YAW)
    assert free[-1] == (yaw,)
    assert kinematics.refinement.encoder_scale[yaw] == pytest.approx(-0.01, abs=5e-3)
    _covered(kinematics)


# By what a sickness of the elbow must be called.
SICK = {
    "gyro_stuck": dead("gyro_rad_s", [0]),
    "accelerometer_stuck": dead("accel_m_s2", [2]),
    "gyro_saturated": saturated("gyro_rad_s", 0.6),
    "encoder_stuck": stuck("position_rad", "velocity_rad_s"),
    "encoder_jump": jumped("position_rad", 0.05),
    "clock_jump": leaping_clock(-300_000_000),
    "messages_missing": silent,
}


def _sick(run: list[Entry], alter: Alterations, serial: str, of: str = "") -> Recording:
    """The recording altered from the middle of its motion on, in its own rows or those `of` another."""
    whole = _altered(run, lambda *_: None)
    (motion,) = [e.motion for e in whole.latest_motions("windowed_sine") if e.serial == serial]
    assert motion is not None
    recording = Recording()
    for entry in alter(run, (of or serial,), (motion.start_row + (motion.end_row or 0)) // 2):
        recording.accept(entry)
    return recording


@pytest.mark.parametrize("kind", SICK)
def test_a_sick_module_is_named_and_the_robot_identified_without_it(run: list[Entry], kind: str) -> None:
    found = identify(_sick(run, SICK[kind], ELBOW))
    assert {(one.serial, one.kind) for one in found.result.sensors if one.serious} >= {(ELBOW, kind)}
    assert found.result.excluded == [ELBOW]
    assert found.result.suspicions
    # The link between the others is as it would be without the elbow, and its claim holds.
    assert found.result.serials == [YAW, LIFT]
    _covered(found.kinematics)


def _stood(run: list[Entry], ill: tuple[str, ...], middle: int) -> list[Entry]:
    """The clock is later by 0.3 s in answers alone: rows of the time that it stood are refused."""
    leapt = leaping_clock(-300_000_000)(run, ill, middle)
    return [late if late.kind == "reply" else entry for late, entry in zip(leapt, run, strict=True)]


def test_a_clock_that_stood_is_named_by_its_answers(run: list[Entry]) -> None:
    found = identify(_sick(run, _stood, ELBOW))
    (finding,) = [one for one in found.result.sensors if one.serious]
    assert (finding.serial, finding.kind) == (ELBOW, "clock_jump")
    assert finding.measured == pytest.approx(-0.3, abs=0.01)
    assert found.result.excluded == [ELBOW]
    _covered(found.kinematics)


def test_a_link_that_turned_and_has_no_length_makes_the_robot_suspect(run: list[Entry]) -> None:
    """The elbow's IMU may be anywhere, by residuals that leave nothing: its lift turned it nevertheless."""
    found = identify_kinematics(_altered(run, lambda *_: None))
    assert found.suspicions == []
    estimate = found.fit
    elbow = found.topology.serials.index(ELBOW)
    anywhere = np.zeros((len(estimate.covariance), 3))
    anywhere[6 * elbow + 3 : 6 * elbow + 6] = np.eye(3)
    lost = replace(estimate, null_basis=anywhere)
    vague = found._replace(refinement=found.refinement._replace(estimate=lost))
    (why,) = vague.suspicions
    assert f"the length of the link {LIFT} - {ELBOW} is not known" in why


def _held_back(run: list[Entry], serial: str) -> list[Entry]:
    """The recording as if this module had refused its motions: the others moved, and it held its joint."""
    refused = exclusion_event(0, serial, "beyond its range", by_limits=True)
    entries = [Entry("journal", "journal", run[0].t_ns, refused.encode())]
    for entry in run:
        event = JournalEvent.decode(entry.payload) if entry.kind == "journal" else None
        if event is None or event.serial != serial or event.what != "motion":
            entries.append(entry)
    return entries


def test_an_encoder_that_jumps_is_named_though_its_module_took_no_part(run: list[Entry]) -> None:
    """Such a module holds its joint, and turns it where its encoder jumps."""
    held_back = _held_back(run, ELBOW)
    healthy = identify_kinematics(_altered(held_back, lambda *_: None))
    # It refused to go home, too: what is known is not the whole robot.
    assert healthy.topology.serials == (YAW, LIFT)
    assert (healthy.findings, healthy.suspicions) == ((), [f"{ELBOW} took no part: beyond its range"])
    found = identify_kinematics(_sick(held_back, jumped("position_rad", 0.05), LIFT, of=ELBOW))
    assert [(one.serial, one.kind) for one in found.findings if one.serious] == [(ELBOW, "encoder_jump")]
    assert (found.topology.serials, found.excluded) == ((YAW, LIFT), ())
    assert ELBOW in found.suspicions[0]
    _covered(found)


def test_an_identification_that_fails_names_who_took_no_part_and_what_is_sick(run: list[Entry]) -> None:
    entries = _held_back(run, ELBOW)
    for serial in (YAW, LIFT):
        entries = dead("accel_m_s2", [0, 1, 2])(entries, (serial,), 0)
    entries = jumped("position_rad", 0.05)(entries, (ELBOW,), 1000)
    with pytest.raises(IdentificationError, match=f"{ELBOW} took no part: beyond its range") as refused:
        identify_kinematics(_altered(entries, lambda *_: None))
    assert {one.serial for one in refused.value.findings} == {YAW, LIFT, ELBOW}
    assert refused.value.exit_code == EXIT_SUSPECT


@pytest.mark.parametrize("sensor", ["gyro", "accelerometer"])
def test_an_imu_of_another_scale_ends_with_its_name_and_the_right_links(
    run: list[Entry], sensor: str
) -> None:
    """5 %. Taken for a bias it makes the link 17 mm longer, taken for the lift's encoder 15 mm shorter."""
    field = {"gyro": "gyro_rad_s", "accelerometer": "accel_m_s2"}[sensor]
    found = identify(_sick(run, multiplied((field,), 1.05), ELBOW))
    (finding,) = found.kinematics.findings
    assert (finding.serial, finding.kind, finding.serious) == (ELBOW, "imu_error", True)
    assert finding.what == f"an error of its {sensor}'s scale or axes"
    assert finding.measured == pytest.approx(0.05, abs=0.01)
    (sentence,) = found.result.suspicions
    assert ELBOW in sentence
    _covered(found.kinematics)
    assert found.kinematics.fit.link_length_sigma_m[1:].max() < 2e-3


def test_readings_that_are_no_numbers_are_counted_and_the_others_used(run: list[Entry]) -> None:
    kinematics = identify_kinematics(_sick(run, not_a_number("gyro_rad_s"), LIFT))
    (finding,) = kinematics.findings
    assert (finding.serial, finding.kind, finding.serious) == (LIFT, "not_finite", True)
    assert finding.measured >= 5
    assert kinematics.excluded == ()
    _covered(kinematics)


def test_a_stuck_torque_sensor_leaves_the_chain_and_takes_the_inertia(run: list[Entry]) -> None:
    kinematics = identify_kinematics(_sick(run, stuck("effort_nm"), LIFT))
    assert [(one.serial, one.kind) for one in kinematics.findings] == [(LIFT, "effort_stuck")]
    assert (kinematics.excluded, kinematics.dynamic) == ((), False)
    _covered(kinematics)


def test_a_robot_of_which_nothing_healthy_is_left_is_refused_by_name(run: list[Entry]) -> None:
    everyone = run
    for serial in (YAW, LIFT, ELBOW):
        everyone = dead("accel_m_s2", [0, 1, 2])(everyone, (serial,), 0)
    with pytest.raises(IdentificationError, match="no other module is left") as refused:
        identify_kinematics(_altered(everyone, lambda *_: None))
    assert refused.value.exit_code == EXIT_SUSPECT
    assert {one.serial for one in refused.value.findings} == {YAW, LIFT, ELBOW}


def test_what_only_the_fit_shows_is_named_where_the_robot_cannot_be_identified_without_it(
    run: list[Entry], monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = _sick(run, multiplied(("gyro_rad_s",), 1.05), ELBOW)
    kinematics = identify_kinematics(recording)
    worst = kinematics.findings[0]._replace(kind="gyro_stuck")
    found = iter([kinematics._replace(findings=(worst,))])

    def fit(*_: Any) -> Kinematics:
        for one in found:
            return one
        raise IdentificationError("no exploration was recorded")

    monkeypatch.setattr("coordinator.identification.identify._identify_kinematics", fit)
    why = f"{ELBOW}: .*; the robot cannot be identified without {ELBOW}: no exploration was recorded"
    with pytest.raises(IdentificationError, match=why) as refused:
        identify_kinematics(recording)
    assert (refused.value.exit_code, refused.value.findings) == (EXIT_SUSPECT, (worst,))


def _relabelled(run: list[Entry], serial: str, label: str) -> list[Entry]:
    entries = []
    for entry in run:
        if (
            entry.kind != "journal"
            and entry.kind != "request"
            and parse(entry.topic)[1:] == (serial, Leaf.INFO)
        ):
            info = decode(Info, entry.payload).model_copy(update={"module_type": label})
            entry = entry._replace(payload=encode(info))
        entries.append(entry)
    return entries


def test_a_module_that_reports_another_type_is_named_by_the_place_of_its_imu(run: list[Entry]) -> None:
    kinematics = identify_kinematics(_altered(_relabelled(run, LIFT, "X5-9-old"), lambda *_: None))
    (finding,) = kinematics.findings
    # The IMU is at x = 25 mm, and by the other type at -30 mm.
    assert (finding.serial, finding.measured) == (LIFT, pytest.approx(55.0, abs=5.0))
    _covered(kinematics)


def test_a_leaf_that_reports_another_type_is_named_by_its_gear_train(run: list[Entry]) -> None:
    # Where its IMU sits in the housing shows in no motion: the claim holds 50 mm for it.
    kinematics = identify_kinematics(_altered(_relabelled(run, ELBOW, "X5-9-old"), lambda *_: None))
    (finding,) = kinematics.findings
    assert (finding.serial, finding.measured) == (ELBOW, pytest.approx(762.0, rel=0.01))
    length_sigma_m = kinematics.fit.link_length_sigma_m[kinematics.topology.serials.index(ELBOW)]
    assert length_sigma_m > 0.04


def test_a_leaf_that_counts_backwards_is_refused_by_its_motor(run: list[Entry]) -> None:
    # Nothing is beyond it that would show the sign.
    with pytest.raises(IdentificationError, match=rf"{ELBOW}: its motor's speed over its joint's is -7"):
        identify_kinematics(_altered(run, _backwards(ELBOW, ENCODER)))


def test_modules_that_hardly_rested_at_the_same_times_are_said_so(
    run: list[Entry], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The low-pass settles within 0.17 s at either end, so that nothing is left of 0.3 s to tell noise by."""

    def shortened(recording: Recording, clocks: Any, serials: Any, event: JournalEvent, *more: Any) -> Any:
        windows = unbroken_windows(recording, clocks, serials, event, *more)
        return [one._replace(t_ns=one.t_ns[:75]) for one in windows] if event.purpose == "rest" else windows

    monkeypatch.setattr("coordinator.identification.identify.unbroken_windows", shortened)
    with pytest.raises(
        IdentificationError, match=r"have 0\.3 s of rest without a hole, at least 0\.38 s are"
    ):
        identify_kinematics(_altered(run, lambda *_: None))
