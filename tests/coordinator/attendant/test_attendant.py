"""The attendant moves a robot only for what lasts, when it is left alone, free, and has been announced."""

import itertools
from collections.abc import Mapping, Sequence

import pytest

from coordinator.attendant.attendant import Attendant, Measurement, Observation, Outcome, Patience
from coordinator.monitoring.findings import Detection, Finding, Kind

ARM = {"base": 11, "elbow": 12, "wrist": 13}
LOOK_S = 0.25
WAIT = Patience()


def found(kind: Kind, at_s: float, serial: str = "wrist") -> Finding:
    return Detection(kind, serial, 0.2, 0.01, 90.0, 30.0, f"a {kind} at {serial}").finding(
        round(at_s * 1e9), round(at_s * 1e9)
    )


class Story:
    """An attendant that looks four times a second at what a test lets happen."""

    def __init__(self, may_move: bool = True, known: Sequence[str] = tuple(ARM)):
        self.attendant = Attendant(known, may_move)
        self.now_s = 0.0
        self.said: list[tuple[float, str]] = []
        self.warned: list[tuple[float, str]] = []
        self.remarks: list[str] = []
        self.present: Mapping[str, int] = ARM
        self.findings: Sequence[Finding] = ()
        self.holders: Mapping[str, str] = {}

    def goes_on(self, seconds: float) -> Measurement | None:
        """Look on; return the measurement that is asked for first, None if there is none."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += LOOK_S
            seen = Observation(round(self.now_s * 1e9), self.present, self.findings, self.holders)
            step = self.attendant.look(seen)
            self.warned += [(self.now_s, line) for line in step.warn]
            self.said += [(self.now_s, line) for line in (*step.say, *step.warn)]
            self.remarks += step.remarks
            if step.measure is not None:
                return step.measure
        return None

    def ends(self, measured: Measurement, outcome: Outcome) -> None:
        step = self.attendant.ended(round(self.now_s * 1e9), measured, outcome)
        self.said += [(self.now_s, line) for line in step.say]

    def heard(self, words: str) -> list[float]:
        return [at_s for at_s, line in self.said if words in line]


def test_ten_hours_of_nothing_are_ten_hours_of_silence() -> None:
    story = Story()
    assert story.goes_on(36_000.0) is None
    assert story.said == []


def test_a_module_that_starts_again_quickly_is_no_change() -> None:
    story = Story()
    story.goes_on(20.0)
    story.present = {s: b for s, b in ARM.items() if s != "wrist"}
    story.goes_on(WAIT.gone_s - 1.0)
    story.present = ARM
    assert story.goes_on(60.0) is None
    assert story.said == []


def test_a_module_that_is_gone_is_said_and_measured_once_the_robot_is_left_alone() -> None:
    story = Story()
    story.goes_on(20.0)
    story.present = {"base": 11, "elbow": 12}
    measured = story.goes_on(60.0)
    assert measured == Measurement("structure", ("module wrist has gone",), ("base", "elbow"))
    assert story.heard("module wrist has gone") == [pytest.approx(20.0 + WAIT.gone_s, abs=2 * LOOK_S)]
    # Not before it is still, and not before the notice has passed.
    assert story.now_s >= 20.0 + WAIT.still_s + WAIT.notice_s
    (announced,) = story.heard("THE ROBOT MOVES")
    # As a warning, which is said where all else is quiet.
    assert [at_s for at_s, _ in story.warned] == [announced]
    assert story.now_s - announced >= WAIT.notice_s


def test_an_exchange_is_said_as_one_and_every_further_plug_begins_the_wait_anew() -> None:
    story = Story()
    story.goes_on(20.0)
    story.present = {"base": 11, "elbow": 12, "spare": 21}
    story.goes_on(WAIT.still_s + 5.0)
    assert story.heard("module wrist was exchanged for spare")
    assert story.heard("THE ROBOT MOVES")
    # In the middle of the notice another module is plugged.
    story.present = {"base": 11, "elbow": 12, "spare": 21, "hand": 22}
    plugged_s = story.now_s
    measured = story.goes_on(60.0)
    assert measured is not None
    assert measured.modules == ("base", "elbow", "hand", "spare")
    assert story.now_s - plugged_s >= WAIT.still_s + WAIT.notice_s


def test_a_module_that_comes_back_in_time_is_no_change_any_more() -> None:
    story = Story()
    story.goes_on(20.0)
    story.present = {"base": 11, "elbow": 12}
    story.goes_on(WAIT.gone_s + 1.0)
    story.present = ARM
    assert story.goes_on(120.0) is None
    assert story.heard("as they are known again")


def test_strangers_that_come_and_go_leave_nothing_behind() -> None:
    story = Story()
    story.goes_on(20.0)
    for number in range(100):
        story.present = {**ARM, f"stranger-{number}": 1}
        story.goes_on(LOOK_S)
    story.present = ARM
    assert story.goes_on(WAIT.gone_s + WAIT.still_s) is None
    assert story.attendant._since.keys() == ARM.keys()


def test_a_robot_that_is_switched_off_and_on_is_no_other_robot() -> None:
    story = Story()
    story.goes_on(20.0)
    story.present = {}
    story.goes_on(600.0)
    story.present = {serial: boot + 100 for serial, boot in ARM.items()}
    assert story.goes_on(120.0) is None
    assert [line for _, line in story.said] == [
        "no module is on the network any more",
        "modules are on the network again",
        "the robot was off, and is as it is known",
    ]


def test_a_robot_that_is_switched_on_later_is_waited_for_and_has_not_changed() -> None:
    story = Story()
    story.present = {}
    assert story.goes_on(600.0) is None
    assert story.remarks == ["waits for the robot: no module is on the network yet"]
    story.present = ARM
    assert story.goes_on(600.0) is None
    assert story.said == []
    # Once it was there, it is gone when it is gone.
    story.present = {}
    story.goes_on(60.0)
    assert [line for _, line in story.said] == ["no module is on the network any more"]


def test_a_module_that_was_off_alone_may_sit_elsewhere() -> None:
    story = Story()
    story.goes_on(20.0)
    story.present = ARM | {"wrist": 99}
    measured = story.goes_on(60.0)
    assert measured is not None
    assert measured.aim == "links"
    assert "wrist was off" in measured.why[0]


@pytest.mark.parametrize(
    ("kind", "aim", "after_s"),
    [("wear", "links", WAIT.link_s), ("payload", "load", WAIT.payload_s)],
)
def test_what_the_monitor_finds_is_measured_if_it_stays(kind: Kind, aim: str, after_s: float) -> None:
    story = Story()
    story.goes_on(20.0)
    story.findings = [found(kind, 20.0)]
    story.goes_on(after_s - 1.0)
    assert not story.said
    measured = story.goes_on(60.0)
    assert measured is not None
    assert measured.aim == aim
    assert measured.why == (f"a {kind} at wrist",)


def test_a_link_that_motions_hardly_show_is_no_reason_to_move() -> None:
    story = Story()
    story.findings = [found("wear", 0.0).model_copy(update={"size": 323.0, "sigma": 46.0})]
    assert story.goes_on(300.0) is None
    assert not story.said


@pytest.mark.parametrize("kind", ["torque-sensor", "gyro", "accelerometer"])
def test_a_sensor_that_is_off_is_said_once_and_nothing_is_measured_by_it(kind: Kind) -> None:
    story = Story()
    story.findings = [found(kind, 0.0)]
    assert story.goes_on(WAIT.unexplained_s - 1.0) is None
    assert not story.said
    assert story.goes_on(300.0) is None
    assert len(story.heard(f"it stays so: a {kind} at wrist")) == 1
    # It is changed for another one, which is off in its turn.
    story.findings = [story.findings[0].model_copy(update={"until_ns": round(story.now_s * 1e9)})]
    story.goes_on(100.0)
    story.findings = [*story.findings, found(kind, story.now_s)]
    story.goes_on(WAIT.unexplained_s + 100.0)
    assert len(story.heard(f"it stays so: a {kind} at wrist")) == 2


def test_a_link_that_turns_out_to_be_an_imu_is_not_measured() -> None:
    story = Story()
    story.holders = {"elbow": "painter"}
    story.findings = [found("wear", 0.0)]
    story.goes_on(WAIT.link_s + 5.0)
    assert story.heard("it stays so: a wear at wrist")
    story.findings = [found("accelerometer", story.now_s)]
    story.goes_on(WAIT.unexplained_s + 5.0)
    story.holders = {}
    assert story.goes_on(300.0) is None


@pytest.mark.parametrize("kind", ["collision", "friction"])
def test_blows_and_stiff_gears_are_no_reason_to_move(kind: Kind) -> None:
    story = Story()
    story.findings = [found(kind, 0.0)]
    assert story.goes_on(300.0) is None


def test_what_is_gone_again_before_it_has_lasted_is_nothing() -> None:
    story = Story()
    story.findings = [found("payload", 0.0)]
    story.goes_on(WAIT.payload_s - 1.0)
    story.findings = [found("payload", 0.0).model_copy(update={"until_ns": 10**10})]
    assert story.goes_on(300.0) is None


def test_a_payload_that_is_put_down_again_is_no_reason_to_move_a_link_that_rests_is() -> None:
    story = Story()
    story.findings = [found("payload", 0.0), found("wear", 0.0)]
    story.holders = {"base": "painter"}
    story.goes_on(60.0)
    over = {"until_ns": 60 * 10**9}
    story.findings = [finding.model_copy(update=over) for finding in story.findings]
    story.goes_on(5.0)
    assert story.heard("the payload is gone again")
    story.holders = {}
    measured = story.goes_on(60.0)
    assert measured is not None
    assert measured.why == ("a wear at wrist",)


def test_without_leave_to_move_it_says_what_changed_and_no_more() -> None:
    story = Story(may_move=False)
    story.findings = [found("wear", 0.0)]
    assert story.goes_on(600.0) is None
    assert len(story.heard("--may-move")) == 1
    assert not story.heard("THE ROBOT MOVES")


def test_a_robot_that_another_program_holds_is_waited_for() -> None:
    story = Story()
    story.findings = [found("wear", 0.0)]
    story.holders = {"elbow": "painter"}
    assert story.goes_on(300.0) is None
    assert len(story.heard("waits until painter releases elbow")) == 1
    story.holders = {}
    released_s = story.now_s
    assert story.goes_on(60.0) is not None
    assert story.now_s - released_s >= WAIT.notice_s


def test_a_program_that_takes_the_robot_during_the_notice_is_waited_for_too() -> None:
    story = Story()
    story.findings = [found("wear", 0.0)]
    story.goes_on(WAIT.still_s + 4.0)
    assert story.heard("THE ROBOT MOVES")
    story.holders = {"base": "painter"}
    assert story.goes_on(60.0) is None
    story.holders = {}
    released_s = story.now_s
    assert story.goes_on(60.0) is not None
    assert story.now_s - released_s >= WAIT.notice_s


def test_after_a_new_model_the_new_modules_are_the_known_ones() -> None:
    story = Story()
    story.present = {"base": 11, "elbow": 12, "spare": 21}
    measured = story.goes_on(60.0)
    assert measured is not None
    story.ends(measured, Outcome("replaced", ("version 2",)))
    assert story.goes_on(600.0) is None
    story.present = ARM
    again = story.goes_on(60.0)
    assert again is not None
    assert again.why == ("module spare was exchanged for wrist",)


def test_a_false_alarm_moves_the_robot_once_an_hour_at_most() -> None:
    story = Story()
    story.findings = [found("wear", 0.0)]
    measured = story.goes_on(60.0)
    assert measured is not None
    story.ends(measured, Outcome("confirmed", ("no link has changed",)))
    begun_s = story.now_s
    story.findings = [found("wear", begun_s + 5.0)]
    again = story.goes_on(2.0 * WAIT.again_s)
    assert again is not None
    assert story.now_s - begun_s >= WAIT.again_s
    # Another link is another matter.
    story.ends(again, Outcome("confirmed"))
    story.findings = [found("wear", story.now_s, "elbow")]
    assert story.goes_on(60.0) is not None


def test_measurements_that_fail_are_tried_again_a_few_times_and_no_more() -> None:
    story = Story()
    story.present = {"base": 11, "elbow": 12}
    begun = []
    while (measured := story.goes_on(600.0)) is not None:
        begun.append(story.now_s)
        story.ends(measured, Outcome("failed", ("elbow is blocked",)))
    assert len(begun) == WAIT.attempts
    assert all(b - a >= WAIT.retry_s for a, b in itertools.pairwise(begun))
    assert story.heard("elbow is blocked")
    # Something else is a new beginning.
    story.present = ARM | {"hand": 22}
    assert story.goes_on(60.0) is not None


def test_of_a_robot_with_other_modules_the_monitor_knows_nothing() -> None:
    story = Story()
    story.present = ARM | {"hand": 22}
    story.findings = [found("wear", 3.0)]
    measured = story.goes_on(60.0)
    assert measured is not None
    assert measured.why == ("module hand is new",)


def test_a_displaced_link_and_a_new_module_are_measured_together() -> None:
    story = Story()
    story.findings = [found("wear", 0.0)]
    story.goes_on(WAIT.link_s + 1.0)
    story.present = ARM | {"hand": 22}
    measured = story.goes_on(60.0)
    assert measured is not None
    assert measured.aim == "links"
    assert measured.why == ("module hand is new", "a wear at wrist")
