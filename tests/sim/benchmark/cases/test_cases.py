"""From trials to rows: what a bar is about reaches the row with it, and nothing is dropped in silence."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from coordinator.recording.recording import Recording
from module_agent.model.catalogue import CATALOGUE
from sim.benchmark import sensor_faults
from sim.benchmark.case import Case, CaseResult, Summary, concluded
from sim.benchmark.cases.arm import (
    ARMS,
    COST_ARM,
    TIP,
    WHOLE_ARM,
    ArmLink,
    ArmTrial,
    TipErrors,
    arm_cases,
    arm_plan,
    sigmas_off,
)
from sim.benchmark.cases.joint import SETTINGS, joint_cases
from sim.benchmark.cases.link_change import DAYS, Checks, LinkChangeTrial, link_change_cases
from sim.benchmark.cases.network import network_cases
from sim.benchmark.cases.suites import (
    ALL,
    KINEMATIC_TRIALS,
    QUICK_KINEMATICS,
    chosen,
    full_kinematics,
    kinematic_cases,
    over_all,
)
from sim.benchmark.cases.topology import TopologyTrial, topology_cases
from sim.benchmark.row import Row
from sim.benchmark.sensor_faults import FAULTS, HARMLESS, QUICK, FaultTrial, fault_cases, relabelled
from sim.robot.random_robot import random_robot
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.scoring.chain_score import LinkErrors, link_errors
from sim.thesis.kinematics.joint_trial import JointTrial
from sim.thesis.published import ALIGNMENTS, LENGTHS_MM
from sim.virtual_time.robot import VirtualSettings


def rows(summary: Summary) -> dict[str, Row]:
    found = {row.figure: row for row in summary.rows}
    assert len(found) == len(summary.rows)
    return found


def case_named(cases: list[Case], name: str) -> Case:
    (found,) = chosen(cases, name)
    return found


# ---------------------------------------------------------------------- what there is


def test_the_quick_benchmark_has_every_case_of_the_full_one_and_fewer_trials() -> None:
    quick, every = kinematic_cases(QUICK_KINEMATICS, seed=0), kinematic_cases(full_kinematics(), seed=0)
    # Of the sensors' faults the quick one has two.
    left_out = [f"sensor faults, {fault}" for fault in FAULTS if fault not in QUICK]
    whole = [case for case in every if case.name not in left_out]
    assert len(whole) == len(every) - len(FAULTS) + len(QUICK)
    # Where the quick one does less of a case than its name says, its name says so.
    for few, many in zip(quick, whole, strict=True):
        assert few.name.startswith(many.name)
    assert [few.name for few in quick if few.name not in {many.name for many in whole}] == [
        "random robots, x5-uncalibrated, the smallest of 10",
        "a2085_06, link change, by all joints at once",
    ]
    assert len({case.name for case in whole}) == len(whole)
    assert all(few.trials for few in quick)
    assert all(len(few.trials) < len(many.trials) for few, many in zip(quick, whole, strict=True))


def test_the_full_benchmark_has_the_trials_that_the_bars_are_about() -> None:
    cases = kinematic_cases(full_kinematics(), seed=0)
    joints = [case for case in cases if " mm " in case.name and case.trials[0].work.__name__ == "joint_trial"]
    assert len(joints) == len(ALIGNMENTS) * len(LENGTHS_MM) * len(SETTINGS) == 24
    assert {len(case.trials) for case in joints} == {KINEMATIC_TRIALS} == {13}
    assert len(case_named(cases, "random robots").trials) == 200
    checks = case_named(cases, "link change").trials
    assert [sum(len(trial.arguments[which]) for trial in checks) for which in (0, 1)] == [13, 100]
    for arm in ARMS:
        assert len(chosen(cases, f"{arm}*joint by joint")) == 2


def test_the_same_modules_are_measured_in_all_profiles_and_other_ones_with_another_seed() -> None:
    def seeds(cases: list[Case], place: int) -> list[set[int]]:
        return [{trial.arguments[place] for trial in case.trials} for case in cases]

    solid, shaking, delivered = seeds(chosen(joint_cases(3, seed=0), "171 mm vertical"), 3)
    assert solid == shaking == delivered
    assert len(solid) == 3
    assert not solid & seeds(chosen(joint_cases(3, seed=1), "171 mm vertical"), 3)[0]
    calibrated, uncalibrated = seeds(chosen(arm_cases(3, seed=0), "arm7"), 2)
    assert calibrated == uncalibrated


def test_faults_that_alter_recordings_share_one_and_faults_of_robots_do_not() -> None:
    cases = {case.name: case for case in fault_cases(2, seed=0)}
    healthy = [trial.shares for trial in cases["sensor faults, none"].trials]
    assert len(set(healthy)) == 2
    assert [trial.shares for trial in cases["sensor faults, two encoders exchanged"].trials] == healthy
    for other in ("links of 100 Nm/rad", "IMUs at 50 Hz"):
        assert [trial.shares for trial in cases[f"sensor faults, {other}"].trials] == ["", ""]


def test_cases_are_chosen_by_a_part_of_their_name_or_a_pattern() -> None:
    cases = kinematic_cases(QUICK_KINEMATICS, seed=0)
    assert chosen(cases, "") == cases
    assert len(chosen(cases, "484 mm vertical")) == len(SETTINGS)
    assert len(chosen(cases, "484 mm*uncalibrated")) == len(ALIGNMENTS)
    assert chosen(cases, "no such thing") == []


# ---------------------------------------------------------------------- joints


def joint(ours_mm: float, thesis_mm: float | None = 5.0, axis_deg: float = 0.01) -> JointTrial:
    return JointTrial(
        thesis_error_m=None if thesis_mm is None else 1e-3 * thesis_mm,
        ours_error_m=1e-3 * ours_mm,
        ours_sigma_m=2e-4,
        bound_m=1e-4,
        axis_error_deg=axis_deg,
        robot_time_s=9.0,
    )


def test_an_arm_on_a_solid_base_is_held_against_half_a_millimetre_and_the_bound() -> None:
    case = case_named(joint_cases(13, 0), "350 mm vertical, x5 on a solid base")
    found = rows(case.summarise([joint(0.4 if n % 2 else -0.2) for n in range(13)]))
    mean = found["length, mean |error| [mm]"]
    assert mean.ours == pytest.approx((6 * 0.4 + 7 * 0.2) / 13)
    assert (mean.thesis, mean.limit, mean.holds) == (pytest.approx(5.0), 0.5, True)
    over = found["length, rms error over the bound"]
    assert over.ours == pytest.approx(((6 * 16 + 7 * 4) / 13) ** 0.5)
    assert (over.thesis, over.bound, over.limit) == (pytest.approx(50.0), 1.0, None)
    assert found["axis, largest error [deg]"].holds


def test_the_thesis_may_find_nothing_where_ours_does() -> None:
    case = case_named(joint_cases(2, 0), "350 mm vertical, x5 on a shaking base")
    found = rows(case.summarise([joint(0.1, thesis_mm=None), joint(0.1, thesis_mm=-3.0)]))
    assert found["length, mean |error| [mm]"].thesis == pytest.approx(3.0)


@pytest.mark.parametrize(("alignment", "limit"), [("vertical", 0.5), ("horizontal", None)])
def test_uncalibrated_arms_have_a_bar_where_gravity_calibrates_their_axis(
    alignment: str, limit: float | None
) -> None:
    case = case_named(joint_cases(13, 0), f"245 mm {alignment}, x5-uncalibrated")
    summary = case.summarise([joint(2.45)] * 13)
    share = rows(summary)["length, mean |error| [%]"]
    assert (share.ours, share.limit) == (pytest.approx(1.0), limit)
    assert summary.sigmas_off == pytest.approx([12.25] * 13)
    half = rows(summary)["length, half of the 95 % interval, mean [%]"]
    assert half.ours == pytest.approx(100 * 1.96 * 0.2 / 245)


# ---------------------------------------------------------------------- arms


def arm(tip_mm: float, **changed: Any) -> ArmTrial:
    ours, thesis = LinkErrors(1e-3, 2e-3, 0.05), LinkErrors(-8e-3, 9e-3, 0.4)
    link = ArmLink(ours, thesis, sigma_m=5e-4, bound_m=2e-4)
    done = ArmTrial(
        network="lan",
        mode="joint",
        seed=1,
        joints=6,
        why="",
        links=(link,),
        tip=TipErrors(1e-3 * tip_mm, 0.08),
        thesis_tip=TipErrors(3e-2, 1.5),
        tip_bound=TipErrors(2e-4, 0.01),
        robot_time_s=54.0,
        identify_s=2.0,
    )
    return done._replace(**changed)


def test_an_arms_tip_is_the_rms_over_its_trials_with_the_thesis_beside() -> None:
    case = case_named(arm_cases(13, 0), f"{COST_ARM}, x5, joint by joint")
    summary = case.summarise([arm(0.6), arm(4.6)] * 6 + [arm(0.6)])
    found = rows(summary)
    tip = found["tip position, rms [mm]"]
    assert tip.ours == pytest.approx(((7 * 0.36 + 6 * 21.16) / 13) ** 0.5)
    assert (tip.thesis, tip.limit, tip.holds) == (pytest.approx(30.0), 2.6, False)
    assert tip.bound == pytest.approx(0.2)
    assert found["tip orientation, rms [deg]"].limit == 0.4
    assert found["robot time a joint, longest [s]"].ours == pytest.approx(9.0)
    assert found["robot time a joint, longest [s]"].thesis == 18.0
    assert found["refinement and all before it, median [s of a core]"].limit == 5.0
    length = found["link length, mean |error| [mm]"]
    assert (length.thesis, length.bound) == (
        pytest.approx(8.0),
        pytest.approx(0.2 * (2 / np.pi) ** 0.5, rel=1e-3),
    )
    assert summary.sigmas_off == pytest.approx([2.0] * 13)


def test_why_an_arm_counts_as_wrong_is_said() -> None:
    case = case_named(arm_cases(13, 0), f"{COST_ARM}, x5, joint by joint")
    trials = [arm(0.6), arm(0.6, seed=2, why="it fell"), arm(0.6, seed=3, differences=("a", "b"))]
    assert case.summarise(trials).reasons == ["seed 2: it fell", "seed 3: a; b"]


def test_uncalibrated_arms_have_four_millimetres_and_no_bar_for_what_their_imus_cannot_know() -> None:
    case = case_named(arm_cases(13, 0), "arm7, x5-uncalibrated")
    found = rows(case.summarise([arm(3.0)] * 13))
    assert found["tip position, rms [mm]"].limit == 4.0
    assert found["tip orientation, rms [deg]"].limit is None
    assert not any("refinement" in figure for figure in found)


def test_shortened_motions_meet_no_bar_of_time_and_one_arm_moves_in_full_all_the_same() -> None:
    cases = chosen(arm_cases(1, 0, shortened=True), "joint by joint")
    limits = [rows(case.summarise([arm(0.5)]))["robot time a joint, longest [s]"].limit for case in cases]
    assert limits == [10.0] + [None] * 5
    plans = [case.trials[0].arguments[-1] for case in cases]
    assert plans[0] == arm_plan("joint", "calibrated")
    assert [plan.imu for plan in plans] == ["calibrated", "uncalibrated"] * 3
    assert all(plan.sine_centre_s < plans[0].sine_centre_s for plan in plans[1:])
    # Whatever motions are chosen: in these cases they are the thesis', shortened.
    quick = kinematic_cases(QUICK_KINEMATICS, seed=0, motions="optimised")
    motions = [c.trials[0].arguments[-1].motions for c in chosen(quick, "joint by joint")]
    assert motions == ["optimised"] + ["standard"] * 5


def test_other_motions_are_those_of_whole_arms_joint_by_joint() -> None:
    cases = kinematic_cases(full_kinematics(1), seed=0, motions="optimised")
    plans = {case.name: case.trials[0].arguments[-1] for case in cases}
    assert all(plan.motions == "optimised" for name, plan in plans.items() if "joint by joint" in name)
    assert plans["a2085_04, x5, clocks apart, wifi"].motions == "optimised"


def test_all_joints_at_once_have_twenty_seconds_in_all() -> None:
    case = case_named(arm_cases(13, 0), f"{WHOLE_ARM}, x5, all")
    trials = [arm(0.9, mode="simultaneous", robot_time_s=19.0, thesis_tip=None)] * 13
    found = rows(case.summarise(trials))
    assert found["robot time in all, longest [s]"].holds
    assert found["tip position, rms [mm]"].thesis is None
    assert not any("a joint" in figure for figure in found)


def test_a_run_without_an_end_or_with_another_topology_misses_a_bar() -> None:
    case = case_named(arm_cases(3, 0), f"{COST_ARM}, x5, joint by joint")
    ended = arm(0.0, why="unfit", links=(), tip=None, thesis_tip=None, robot_time_s=0.0)
    other = arm(0.5, differences=("b is on a",), tip=None, thesis_tip=None)
    found = rows(case.summarise([arm(0.5), ended, other]))
    wrong = found["runs without the right topology, of 3"]
    assert (wrong.ours, wrong.limit, wrong.holds) == (2.0, 0.0, False)
    assert found["tip position, rms [mm]"].ours == pytest.approx(0.5)
    assert rows(case.summarise([ended]))["tip position, rms [mm]"].holds is False


# ---------------------------------------------------------------------- topology, networks, link change


def test_one_wrong_robot_of_two_hundred_misses_the_bar() -> None:
    case = case_named(topology_cases(200, 0), "random robots")
    right = TopologyTrial(0, 5, (), 0.999, 0, 30.0)
    wrong = right._replace(differences=("b is on a",), confidence=0.6, repeats=2)
    found = rows(case.summarise([right] * 199 + [wrong]))
    bar = found["wrong topology or mounting, of 200"]
    assert (bar.ours, bar.limit, bar.holds) == (1.0, 0.0, False)
    assert found["least confidence of all"].ours == 0.6
    assert rows(case.summarise([right] * 200))["wrong topology or mounting, of 200"].holds


@pytest.mark.parametrize("small", [False, True])
def test_another_seed_means_other_robots(small: bool) -> None:
    first, second = ({t.arguments[0] for t in topology_cases(5, s, small)[0].trials} for s in (0, 1))
    assert len(first) == len(second) == 5
    assert not first & second


def test_small_robots_are_the_smallest_of_ten() -> None:
    (trial,) = topology_cases(1, 0, small=True)[0].trials
    sizes = [len(random_robot(seed).modules) for seed in range(10)]
    assert sizes[trial.arguments[0]] == min(sizes)


def test_a_length_of_which_nothing_is_claimed_is_covered_by_no_claim() -> None:
    trial = network("lan", 0, 1.0)
    unknown = trial.links[0]._replace(sigma_m=np.inf)
    assert sigmas_off([trial._replace(links=(unknown, trial.links[1]))]) == [np.inf, pytest.approx(1.0)]


def network(name: str, seed: int, error_mm: float, **changed: Any) -> ArmTrial:
    links = tuple(
        ArmLink(LinkErrors(1e-3 * sign * error_mm, 2e-3, 0.01), None, 1e-3, 1e-3) for sign in (1.0, -1.0)
    )
    done = ArmTrial(
        network=name,
        mode="joint",
        seed=seed,
        joints=4,
        why="",
        links=links,
        tip=TipErrors(2e-3 * error_mm, 0.02),
        robot_time_s=40.0,
        clock_error_s=5e-6,
        clock_sigma_s=5e-6,
    )
    return done._replace(**changed)


def test_a_network_is_compared_on_the_same_modules_and_where_both_came_to_a_result() -> None:
    pair, _ = network_cases(3, 0)
    assert len(pair.trials) == 6
    trials = [network("none", s, 1.0) for s in range(3)] + [network("wifi", s, 1.1) for s in range(2)]
    lost = network("wifi", 2, 0.0, why="ModuleLost: gone", links=(), tip=None)
    found = rows(pair.summarise([*trials, lost]))
    assert found["runs without the right topology, of 3"].ours == 1.0
    for figure in ("tip position", "link lengths"):
        row = found[f"{figure}, rms error over a perfect network's"]
        assert row.ours == pytest.approx(1.1)
    assert found["tip position, rms [mm]"].ours == pytest.approx(2.2)


def test_a_poor_network_that_moves_the_estimates_by_a_third_misses_its_bar() -> None:
    pair, _ = network_cases(13, 0)
    trials = [network(name, s, e) for s in range(13) for name, e in (("none", 1.0), ("wifi", 1.33))]
    row = rows(pair.summarise(trials))["link lengths, rms error over a perfect network's"]
    assert (row.limit, row.holds) == (1.2, False)


def test_over_a_bad_network_intervals_must_cover() -> None:
    _, bad = network_cases(13, 0)
    shy = bad.summarise([network("bad", s, 2.5) for s in range(13)])
    (row,) = (row for row in shy.rows if "cover" in row.figure)
    assert (row.ours, row.holds) == (0.0, False)
    assert len(shy.sigmas_off) == 26


def check(**changed: Any) -> LinkChangeTrial:
    done = LinkChangeTrial(
        located=True,
        size_error_m=2e-4,
        false_alarm=False,
        robot_time_s=40.0,
    )
    return done._replace(**changed)


def test_a_change_must_be_found_located_and_sized_in_time() -> None:
    (case,) = link_change_cases(3, 0, 0)
    lost = check(located=False, size_error_m=None)
    checks = [Checks((check(), check(size_error_m=6e-4)), ()), Checks((lost,), ())]
    found = rows(case.summarise(checks))
    assert found["2 mm not detected, or not located, of 3"].ours == 1.0
    assert found["size of the 2 mm, largest error [mm]"].holds is False
    assert found["robot time of a check, longest [s]"].holds


def test_a_false_alarm_misses_its_bar() -> None:
    (case,) = link_change_cases(3, 3, 0)
    quiet = check(located=False, size_error_m=None)
    alarm = "false alarms without a change, of 3"
    assert rows(case.summarise([Checks((), (quiet,) * 3)]))[alarm].holds
    assert rows(case.summarise([Checks((), (quiet, quiet, check(false_alarm=True)))]))[alarm].holds is False


def test_checks_of_one_robot_are_made_in_one_process() -> None:
    (case,) = link_change_cases(13, 100, 0)
    assert [[len(seeds) for seeds in trial.arguments[:2]] for trial in case.trials] == [
        [3, DAYS],
        [3, DAYS],
        [3, DAYS],
        [2, DAYS],
        [2, DAYS],
    ]
    robots = [{seed // DAYS for seeds in trial.arguments[:2] for seed in seeds} for trial in case.trials]
    assert all(len(each) == 1 for each in robots)
    assert len(set.union(*robots)) == 5


# ---------------------------------------------------------------------- what was not measured


@pytest.mark.parametrize("case", kinematic_cases(QUICK_KINEMATICS, seed=0), ids=lambda case: case.name)
def test_no_bar_is_met_by_trials_that_all_failed(case: Case) -> None:
    assert [row.holds for row in case.summarise([]).rows if row.limit is not None].count(True) == 0


# ---------------------------------------------------------------------- over all


def test_coverage_is_counted_over_the_intervals_of_all_cases() -> None:
    def bold(_: Any) -> Summary:
        return Summary([], (0.5,) * 30 + (3.0,) * 70)

    def shy(_: Any) -> Summary:
        return Summary([], (0.5,) * 900)

    results = [concluded(Case(name, [], how), []) for name, how in (("bold", bold), ("shy", shy))]
    (row,) = over_all(results)
    assert (row.case, row.ours, row.holds) == (ALL, pytest.approx(93.0), True)
    assert over_all(results[:1])[0].holds is False
    assert over_all([]) == []


def test_the_tips_of_many_arms_are_within_half_as_much_again_as_their_bound() -> None:
    def held(errors: Sequence[float]) -> Row:
        (row,) = over_all([CaseResult("arm", 1, Summary([], (), {TIP: errors}), ())])
        return row

    assert held([1.4] * 26).holds
    assert held([1.6] * 26).holds is False
    # One arm's tip may be twice as far off by chance, and not three times.
    assert held([1.9]).holds
    assert held([2.5]).holds is False


# ---------------------------------------------------------------------- sensor faults


def test_a_link_that_is_wrong_without_a_finding_is_a_miss() -> None:
    (case,) = fault_cases(4, seed=0, faults=["links of 100 Nm/rad"])
    trials = [
        FaultTrial(named=True, others=(), sigmas_off=(5.0, 0.1), text=""),
        FaultTrial(named=False, others=(), sigmas_off=(5.0, 0.1), text=""),
        FaultTrial(named=False, others=("B",), sigmas_off=(0.5, 0.1), text=""),
        # Refused without a name of what is wrong.
        FaultTrial(named=False, others=(), sigmas_off=(), text="a fit failed"),
    ]
    shown = rows(concluded(case, 5 * trials).summary)
    assert (shown["wrong in silence, of 20"].ours, shown["wrong in silence, of 20"].holds) == (10.0, False)
    assert shown["named, of 20"].ours == 5.0
    assert shown["another module named, of 20"].ours == 5.0
    # Intervals count where nothing is named: three of four cover.
    assert shown["95 % intervals that cover, of 20 [%]"].ours == 75.0
    # Few of them count with those of all cases.
    few = concluded(case, trials).summary
    assert few.sigmas_off == [5.0, 0.1, 0.5, 0.1]
    assert not [figure for figure in rows(few) if "cover" in figure]


def test_findings_on_healthy_robots_are_misses() -> None:
    assert (
        "none",
        *(f"IMUs at {rate} Hz" for rate in (50, 100, 500, 1000)),
        "a hole in a motion",
    ) == HARMLESS
    (case,) = fault_cases(1, seed=0, faults=["none"])
    healthy, named = (FaultTrial(name, (), (0.5,), "") for name in (False, True))
    figure = "findings on healthy robots, of 1"
    assert rows(concluded(case, [healthy]).summary)[figure].holds
    assert not rows(concluded(case, [named]).summary)[figure].holds


def test_a_wrong_type_puts_the_housing_where_it_is_not() -> None:
    robot = load_robot("a2085_03")
    truth, built = true_chain(robot), {m.serial: CATALOGUE[m.type] for m in robot.modules}
    same = relabelled(truth, built, built)
    np.testing.assert_allclose(same.imu_home, truth.imu_home, atol=1e-15)
    # The elbow's IMU is seen where it is, 55 mm along its housing from where the other type has it.
    wrong = relabelled(truth, built | {"elbow": CATALOGUE["X5-9-old"]}, built)
    errors = link_errors(wrong, truth, truth.serials.index("elbow"))
    assert errors is not None
    away_m = np.linalg.norm(np.subtract(CATALOGUE["X5-9-old"].imu_xyz, CATALOGUE["X5-4"].imu_xyz))
    # The distance from the axis has no part along the axis.
    assert 0.05 < errors.vector_m <= away_m


def test_faults_of_one_seed_share_a_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded: list[int] = []

    def record(settings: VirtualSettings, plan: Plan, recording: Recording) -> None:
        recorded.append(settings.seed)

    monkeypatch.setattr(sensor_faults, "record_session", record)
    for seed in (901, 901, 902):
        assert "rest" in sensor_faults.fault_trial("none", seed, Plan()).text
    assert recorded == [901, 902]
