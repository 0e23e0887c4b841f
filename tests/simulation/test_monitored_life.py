"""Minutes of everyday use under the monitor: a change is named, a seed repeats, a canary sings."""

from pathlib import Path

import numpy as np
import pytest

from coordinator.baseline.baseline_robot import BaselineRobot
from coordinator.monitoring.findings import Kind
from coordinator.monitoring.monitor import Monitor
from coordinator.monitoring.reference import (
    ALONE_FACTOR,
    Reference,
    build_reference,
    steps_of_run,
)
from coordinator.monitoring.segments import Alignment
from sim.benchmark.monitored_life import (
    KnownRobot,
    Life,
    LifePlan,
    false_alarms,
    known_robot_of,
    monitored_life,
)
from sim.benchmark.slow_change import ChangeKind
from sim.imperfections.module_errors import draw_sensor_errors
from sim.imperfections.noise_profile import noise_profile

# Tests of this group share recorded runs: they stay in one process.
pytestmark = pytest.mark.xdist_group("monitored life")

# A robot that half a minute has made known, with calibrated sensors.
PLAN = LifePlan("a2085_03", 3, "x5", day=0, for_s=20.0, excitation="d-optimal", brief=True)

# Days on which the drawn change is one of the larger ones; of the torque sensor one that its drive tells.
DAYS: dict[ChangeKind, int] = {"torque-offset": 5, "accel-bias": 2}


def test_friction_that_doubles_is_named_on_its_module() -> None:
    stiff = monitored_life(PLAN._replace(change="friction", for_s=45.0, from_s=12.0, over_s=10.0))
    assert stiff.change is not None
    assert stiff.rightly, stiff.said
    named = stiff.rightly[0]
    assert named.serial == stiff.change.serial
    assert named.t_s > stiff.change.from_s
    assert named.change_size > 0.0


@pytest.mark.parametrize(
    ("change", "kind"), [("torque-offset", "torque-sensor"), ("accel-bias", "accelerometer")]
)
def test_a_sensor_that_goes_off_is_named_on_its_module_and_nothing_else_is_in_the_end(
    change: ChangeKind, kind: Kind
) -> None:
    """Grown within ten seconds; for a payload or a displaced link it is taken for seconds at most."""
    sick = monitored_life(
        PLAN._replace(change=change, for_s=60.0, from_s=12.0, over_s=10.0, day=DAYS[change])
    )
    assert sick.outcome == "rightly", sick.said
    assert {one.kind for one in sick.rightly} == {kind}


ONE_MODULE = """
name = "one"
network = "lan"
[base]
mount = "floor"
[[module]]
serial = "only"
type = "X5-4"
parent = "base"
payload = { mass_kg = 0.3, com_xyz_m = [0.1, 0.0, 0.05] }
"""


def test_a_robot_of_one_module_has_no_link_and_yet_a_gyro_that_is_watched(tmp_path: Path) -> None:
    robot = tmp_path / "one.toml"
    robot.write_text(ONE_MODULE)
    plan = PLAN._replace(robot=str(robot), noise="x5-uncalibrated")
    sick = monitored_life(plan._replace(change="gyro-bias", day=1, for_s=45.0, from_s=12.0, over_s=10.0))
    assert sick.outcome == "rightly", sick.said
    assert {(one.kind, one.serial) for one in sick.rightly} == {("gyro", "only")}
    assert not monitored_life(plan).said


def test_a_seed_repeats_a_life_and_another_day_is_another_life() -> None:
    sensitive = PLAN._replace(alarms_per_hour=1e9)

    def without_cost(life: Life) -> Life:
        return life._replace(cpu_s=0.0)

    one, again, other = (
        without_cost(monitored_life(plan)) for plan in (sensitive, sensitive, sensitive._replace(day=1))
    )
    assert one == again
    assert one.said != other.said


def test_an_oversensitive_monitor_is_counted_as_false_alarms() -> None:
    """The canary: with thresholds that chance exceeds all the time, a count of none would be blind."""
    alarms = false_alarms([monitored_life(PLAN._replace(alarms_per_hour=1e9))])
    assert alarms.alarms > 0
    assert alarms.per_hour > 100.0


def test_a_run_of_one_joint_at_a_time_is_compared_more_coarsely_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = PLAN.robot, PLAN.seed, PLAN.noise, PLAN.excitation, True
    together = known_robot_of(*known).reference
    monkeypatch.setattr("coordinator.monitoring.reference.moved_together", lambda *_: False)
    alone = known_robot_of.__wrapped__(*known).reference
    assert together.remarks == ()
    assert "hardly moved its joints together" in alone.remarks[0]
    np.testing.assert_allclose(alone.contact.sigma_nm, ALONE_FACTOR * together.contact.sigma_nm)
    # Gains are squares of sizes.
    assert alone.torque.inflation == pytest.approx(ALONE_FACTOR**2 * together.torque.inflation)
    assert alone.imu.inflation == pytest.approx(ALONE_FACTOR**2 * together.imu.inflation)


@pytest.fixture(scope="module")
def uncalibrated() -> tuple[BaselineRobot, KnownRobot]:
    """A run of a robot whose torque sensors have offsets, and what is known from it."""
    baselines: list[BaselineRobot] = []

    def keep(known: BaselineRobot) -> Reference:
        baselines.append(known)
        return build_reference(known)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sim.benchmark.monitored_life.build_reference", keep)
        known = known_robot_of.__wrapped__(PLAN.robot, PLAN.seed, "x5-uncalibrated", PLAN.excitation, True)
    return baselines[0], known


def test_a_robot_is_known_from_what_it_did_in_the_steps_of_its_run(
    uncalibrated: tuple[BaselineRobot, KnownRobot],
) -> None:
    """Before and after them it may have been limp, and pushed by what it lay on."""
    baseline, _ = uncalibrated
    recording, clocks = baseline.recording, baseline.kinematics.clocks
    whole = Alignment(baseline.chain.serials).advance(recording, clocks).block
    motions, [block] = steps_of_run(baseline)
    assert whole is not None
    steps = [event.t_ns for event in recording.journal if event.step]
    assert whole.t_ns[0] < steps[0] - 1e9
    assert steps[0] <= block.t_ns[0] < steps[0] + 4e6
    assert block.t_ns[-1] < steps[-1]
    dynamic = recording.motions("dynamic")
    assert len(motions) == len({event.step for event in dynamic})


def test_torque_sensors_offsets_are_known_from_the_run_and_taken_off(
    uncalibrated: tuple[BaselineRobot, KnownRobot],
) -> None:
    baseline, known = uncalibrated
    reference, serials = known.reference, known.robot.serials
    types = [reference.types[reference.chain.serials.index(serial)] for serial in serials]
    errors = draw_sensor_errors(PLAN.seed, serials, types, noise_profile("x5-uncalibrated"))
    truth = dict(zip(serials, errors.effort_offset_nm, strict=True))
    off_nm = np.array([truth[serial] for serial in reference.chain.serials]) - reference.torque_offset_nm
    # Of the second joint, which bears the arm, weight and offset are told apart less well.
    np.testing.assert_array_less(np.abs(off_nm), [5e-3, 0.03, 5e-3])
    # What a monitor takes off of the torques acts from outside for it; its low-pass has settled long before.
    further_nm = np.array([0.5, -0.25, 1.0])
    felt = []
    for offset_nm in (reference.torque_offset_nm, reference.torque_offset_nm + further_nm):
        monitor = Monitor(reference._replace(torque_offset_nm=offset_nm))
        monitor.advance(baseline.recording, baseline.kinematics.clocks)
        assert monitor.outside_nm is not None
        felt.append(monitor.outside_nm)
    np.testing.assert_allclose(felt[1] - felt[0], further_nm, atol=1e-6)
