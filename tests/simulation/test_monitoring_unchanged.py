"""An unchanged robot raises no alarm, whatever the network does to its feedback."""

import pytest

from coordinator.monitoring.monitor import WORST_CLOCK_NS, Monitor, MonitorUpdate
from coordinator.recording.recording import Recording
from module_agent.signals.clock_map import ClockMap
from sim.benchmark.cases.monitored_robot import WorldEvent, monitor_robot
from sim.benchmark.cases.monitoring import (
    Alarms,
    MonitoringTrial,
    Subject,
    confusion,
    known_subject,
    settings_of,
)

# Tests of this group share recorded runs: they stay in one process.
pytestmark = pytest.mark.xdist_group("monitoring")

ARM = Subject(robot="a2085_03", seed=3, brief=True)


def notes_of(subject: Subject, for_s: float, *events: WorldEvent) -> tuple[Monitor, list[str]]:
    known = known_subject(ARM)
    monitor = Monitor(known.reference)
    notes: list[str] = []

    def report(update: MonitorUpdate, now_ns: int) -> None:
        notes.extend(update.notes)

    monitor_robot(settings_of(known.robot, subject, 9), known.motions, for_s, monitor, report, events)
    return monitor, notes


def test_nothing_is_found_of_a_robot_that_has_not_changed() -> None:
    monitor, notes = notes_of(ARM, 12.0)
    assert monitor.finding_log.all == ()
    assert notes == []
    assert monitor.monitored_s > 11.0


def test_a_poor_network_is_named_and_nothing_is_concluded_from_what_it_leaves() -> None:
    monitor, notes = notes_of(ARM._replace(network="bad"), 12.0)
    assert monitor.finding_log.all == ()
    assert any("the network is slow" in note for note in notes)


def test_whose_clock_is_slow_is_said_once_and_again_when_it_is_not() -> None:
    known = known_subject(ARM)
    monitor, (first, *others) = Monitor(known.reference), known.robot.serials
    accurate = ClockMap(0, 0.0, 0.0, sigma_ns=0.1 * WORST_CLOCK_NS)
    slow = accurate._replace(sigma_ns=2.5 * WORST_CLOCK_NS)

    def said(of_first: ClockMap) -> list[str]:
        clocks = dict.fromkeys(others, accurate) | {first: of_first}
        return [note for note in monitor.advance(Recording(), clocks).notes if "feedback" not in note]

    assert said(accurate) == []
    assert said(slow) == [
        f"the network is slow: when {first} read what they say is known to 2.5 ms only, and 1.0 ms are "
        "needed; only friction is watched, each drive by itself"
    ]
    assert said(slow) == []
    assert said(accurate) == ["all clocks are accurate again: the tests go on"]


def test_rates_have_the_interval_of_poisson() -> None:
    # Garwood's table: none counted, at most 3.69; three counted, 0.619 to 8.77.
    low, high = Alarms(0, 3600.0).interval_per_hour()
    assert (low, high) == pytest.approx((0.0, 3.689), abs=1e-3)
    assert Alarms(3, 3600.0).interval_per_hour() == pytest.approx((0.6187, 8.767), abs=1e-3)
    assert Alarms(3, 7200.0).per_hour == 1.5


def test_a_table_counts_what_was_taken_for_what() -> None:
    trial = MonitoringTrial("wear", "payload", False, None, None, 1.0, None, 0, 10.0, ())
    table = confusion([trial, trial._replace(found="wear"), trial])
    assert table == {"wear": {"payload": 2, "wear": 1}}
