"""Events on a known arm that moves are named, located and sized by the monitor; there is nothing else."""

from typing import Any

import numpy as np
import pytest

from coordinator.monitoring.findings import Finding
from coordinator.monitoring.monitor import Monitor, MonitorUpdate
from coordinator.monitoring.segments import Aligned, Alignment
from sim.benchmark.cases.monitored_robot import WorldEvent, monitor_robot
from sim.benchmark.cases.monitoring import (
    Happens,
    MonitoringTrial,
    Subject,
    known_subject,
    monitoring_trial,
    settings_of,
)
from sim.geometry.link_parts import FreePose
from sim.imperfections.ageing import Ageing
from sim.robot.variants import loaded
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


def test_a_weak_blow_is_no_torque_sensor_that_is_off() -> None:
    """Too weak to be detected as one, it passes for a sensor in a short window and in no long one."""
    assert monitoring_trial("collision", 8, Subject()).words == ()


def test_a_link_that_slipped_is_no_payload_as_imus_see_it_too() -> None:
    trial = tried("wear")
    assert trial.located
    # Also by the length along an axis that these seconds hardly show.
    assert trial.size_error == pytest.approx(0.0, abs=0.33 * trial.size)


def test_a_weight_is_weighed_though_a_gyro_is_off() -> None:
    """Torques need no IMU: the gyro goes on being named, and later the weight is."""
    known = known_subject(ARM)
    monitor = Monitor(known.reference)
    last = known.robot.serials[-1]
    weight = FreePose(mass_kg=0.25, com_xyz_m=(0.03, 0.02, 0.02), inertia=(1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0))
    heavier = loaded(known.robot, last, weight)
    events = (
        WorldEvent(4.0, lambda world: world.age(last, Ageing(gyro_scale=0.06))),
        WorldEvent(12.0, lambda world: world.become(heavier)),
    )
    said: list[Finding] = []

    def report(update: MonitorUpdate, now_ns: int) -> None:
        said.extend(update.findings)

    monitor_robot(settings_of(known.robot, ARM, 5), known.motions, 20.0, monitor, report, events)
    held = {finding.kind: finding for finding in monitor.finding_log.held.values()}
    assert set(held) == {"gyro", "payload"}, monitor.finding_log.all
    assert {finding.serial for finding in held.values()} == {last}
    assert held["payload"].size == pytest.approx(0.25, rel=0.1)
    # Three torque sensors, each good to 5 %, weigh no better than their mean.
    assert held["payload"].sigma > 0.25 * 0.05 / 3**0.5
    # By how much it is off depends on the motion: that is no news every second.
    assert len([finding for finding in said if finding.kind == "gyro"]) <= 4


@pytest.mark.parametrize("leap_rad", [1.0, 500.0])
def test_an_encoder_that_leaps_is_said_and_what_it_shows_is_left_out(
    leap_rad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The low-pass makes a huge speed of it, by which no torque can be predicted."""
    known = known_subject(ARM)
    monitor = Monitor(known.reference)
    advance = Alignment.advance

    def leaping(self: Alignment, *what: Any) -> Aligned:
        aligned = advance(self, *what)
        if aligned.block is None:
            return aligned
        q_rad = np.array(aligned.block.q_rad)
        q_rad[aligned.block.t_ns >= 4_000_000_000, 1] += leap_rad
        return aligned._replace(block=aligned.block._replace(q_rad=q_rad))

    monkeypatch.setattr(Alignment, "advance", leaping)
    notes: list[str] = []

    def report(update: MonitorUpdate, now_ns: int) -> None:
        notes.extend(update.notes)

    monitor_robot(settings_of(known.robot, ARM, 5), known.motions, 5.0, monitor, report)
    said = [note for note in notes if "its encoder leaps" in note]
    assert said
    assert all(known.robot.serials[1] in note for note in said)


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
