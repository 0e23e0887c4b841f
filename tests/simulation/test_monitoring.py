"""Events on a known arm that moves are named, located and sized by the monitor; there is nothing else."""

import pytest

from coordinator.monitoring.findings import Finding
from coordinator.monitoring.monitor import Monitor, MonitorUpdate
from sim.benchmark.cases.monitored_robot import WorldEvent, monitor_robot
from sim.benchmark.cases.monitoring import (
    Happens,
    MonitoringTrial,
    Subject,
    known_subject,
    monitoring_trial,
    settings_of,
)
from sim.world.external_force import Push

# Tests of this group share recorded runs: they stay in one process.
pytestmark = pytest.mark.xdist_group("monitoring")

# One robot for all tests of the file, recorded once.
ARM = Subject(robot="a2085_03", seed=3, brief=True)
SOON_S = 6.0


def tried(happens: Happens, seed: int = 1) -> MonitoringTrial:
    trial = monitoring_trial(happens, seed, ARM, SOON_S)
    assert trial.found == happens, trial.words
    assert trial.false_alarms == 0, trial.words
    return trial


def test_a_weight_is_told_from_a_blow_and_weighed() -> None:
    trial = tried("payload")
    assert trial.located
    assert trial.latency_s is not None
    # Two samples of 4 ms, the network, and a look every 20 ms; more where the weight comes on at standstill.
    assert trial.latency_s < 0.1
    assert trial.named_s is not None
    assert trial.named_s < 4.0
    assert trial.size_error == pytest.approx(0.0, abs=0.03 * trial.size)


def test_a_blow_is_said_within_some_hundredths_of_a_second() -> None:
    trial = tried("collision")
    assert trial.latency_s is not None
    assert trial.latency_s < 0.06


def test_stiff_gears_are_the_drives_and_of_no_other_joint() -> None:
    trial = tried("friction")
    assert trial.located
    # A third of the change: at first the window holds what was before.
    assert trial.size_error == pytest.approx(0.0, abs=0.33 * trial.size)


def test_stiff_gears_are_no_torque_sensor_that_is_off() -> None:
    """On this day the joint turns back just after the change: an offset fits the mixture better."""
    trial = monitoring_trial("friction", 0, ARM._replace(seed=0), SOON_S)
    assert trial.found == "friction", trial.words
    assert trial.false_alarms == 0, trial.words


def test_a_link_that_slipped_is_no_payload_as_imus_see_it_too() -> None:
    trial = tried("wear")
    assert trial.located
    # Also by the length along an axis that these seconds hardly show.
    assert trial.size_error == pytest.approx(0.0, abs=0.33 * trial.size)


def test_a_hand_that_holds_the_arm_for_seconds_is_not_weighed() -> None:
    known = known_subject(ARM)
    monitor = Monitor(known.reference)
    hand = Push(serial="elbow", force_n=(6.0, 8.0, -4.0), at_m=(0.1, 0.0, 0.0), from_s=5.0, for_s=3.0)
    event = WorldEvent(4.0, lambda world: world.push(hand))
    findings: list[Finding] = []

    def report(update: MonitorUpdate, now_ns: int) -> None:
        findings.extend(update.findings)

    monitor_robot(settings_of(known.robot, ARM, 5), known.motions, 9.0, monitor, report, (event,))
    # At first it is a blow like any other.
    assert findings[0].kind == "collision"
    assert findings[0].since_ns == pytest.approx(5.0e9, abs=0.1e9)
    assert {finding.kind for finding in findings} <= {"collision", "unexplained"}
