"""Every bar can be missed: each measured thing is broken once, and the row that is about it fails."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sim.benchmark.case import Case, CaseResult, Trial, concluded
from sim.benchmark.cases.arm import ArmLink, ArmTrial, TipErrors
from sim.benchmark.cases.gravity_compensation import CompensationTrial
from sim.benchmark.cases.inertia import InertiaTrial
from sim.benchmark.cases.link_change import Checks, LinkChangeTrial
from sim.benchmark.cases.monitoring import Alarms, MonitoredSegments, MonitoringTrial
from sim.benchmark.cases.network import PERFECT
from sim.benchmark.cases.payload import PayloadTrial
from sim.benchmark.cases.reassembly import Reassembly
from sim.benchmark.cases.regressor import RegressorTrial
from sim.benchmark.cases.suites import (
    QUICK_DYNAMICS,
    QUICK_KINEMATICS,
    dynamic_cases,
    full_dynamics,
    full_kinematics,
    kinematic_cases,
    over_all,
)
from sim.benchmark.cases.topology import TopologyTrial
from sim.benchmark.sensor_faults import FaultTrial
from sim.scoring.chain_score import LinkErrors
from sim.thesis.dynamics.torque_assistance import Follow
from sim.thesis.dynamics.torque_assistance_cases import Combination
from sim.thesis.kinematics.joint_trial import JointTrial

Change = Callable[[Any], Any]

TX40 = Path("tx40")
EFFORTS = {
    "quick": [*kinematic_cases(QUICK_KINEMATICS, 0), *dynamic_cases(QUICK_DYNAMICS, 0, TX40)],
    "full": [*kinematic_cases(full_kinematics(), 0), *dynamic_cases(full_dynamics(), 0, TX40)],
}


def _arm(trial: Trial) -> ArmTrial:
    _, _, seed, mode, network, _ = trial.arguments
    link = ArmLink(LinkErrors(2e-4, 3e-4, 0.01), LinkErrors(-8e-3, 9e-3, 0.4), sigma_m=2e-4, bound_m=2e-4)
    tips = {name: TipErrors(2e-4, 0.01) for name in ("tip", "thesis_tip", "tip_bound", "strict_tip_bound")}
    done = ArmTrial(network, mode, seed, 4, "", links=(link,) * 3, robot_time_s=15.0, identify_s=2.0)
    return done._replace(**tips, clock_error_s=5e-6, clock_sigma_s=5e-6)


def _monitored(trial: Trial) -> MonitoredSegments:
    drawn, quiet, _, segment_s, _ = trial.arguments
    events = (MonitoringTrial(kind, kind, True, 0.1, 0.2, 0.2, 0.01, 0, 20.0, ()) for kind, _ in drawn)
    return MonitoredSegments(tuple(events), tuple(Alarms(0, segment_s) for _ in quiet))


def _follow(rms: float, unstable: str = "") -> Follow:
    return Follow(rms, 0.0, 0.0, 0.0, unstable, np.empty((0, 1)), np.empty((0, 1)))


def _assisted(trial: Trial) -> list[Combination]:
    return [Combination(case, (_follow(3.0), _follow(2.0), _follow(0.5))) for case in trial.arguments[1]]


def _recorded(_: Trial) -> Any:
    kinds = [(m, t, s) for m in ("fitted", "bodies") for t in ("filtered", "raw") for s in ("all", "masked")]
    return SimpleNamespace(
        held_out=[
            SimpleNamespace(model=m, torque=t, samples=s, tried_on="both", overall=0.01) for m, t, s in kinds
        ]
    )


def _checked(trial: Trial) -> Checks:
    changed, same = trial.arguments[:2]
    return Checks(
        (LinkChangeTrial(True, 1e-4, False, 40.0),) * len(changed),
        (LinkChangeTrial(False, None, False, 40.0),) * len(same),
    )


def _weighed(trial: Trial) -> InertiaTrial:
    arm, _, seed, _, poses, label = trial.arguments
    return InertiaTrial(
        arm,
        label,
        seed,
        "",
        rank=20,
        designed_rank=20,
        sigmas_off=(0.5,) * 20,
        largest=(0.001,) * 10,
        largest_sigma=(0.002,) * 10,
        held_out=0.005,
        with_true_chain=0.005,
        thesis=0.01,
        bodies=0.005,
        poses=poses,
    )


# What a trial returns if all is well, by the function that it calls.
GOOD: Mapping[str, Callable[[Trial], Any]] = {
    "joint_trial": lambda _: JointTrial(5e-3, 1e-4, 1e-4, 1e-4, 0.01, 9.0),
    "arm_trial": _arm,
    "topology_trial": lambda _: TopologyTrial(0, 5, (), 0.999, 0, 30.0),
    "checks_of_one_robot": _checked,
    "fault_trial": lambda _: FaultTrial(False, (), (0.5, 0.5), ""),
    "regressor_trial": lambda _: RegressorTrial(0.3, 0.6, 1.0, 3.0, 0.3, 4.0, 1e-15),
    "inertia_trial": _weighed,
    "reassembly_in_folder": lambda _: Reassembly(60, (15,) * 3, 29, 0.7, (0.7,) * 3, 1e-15, (1.0,) * 3),
    "payload_trial": lambda trial: PayloadTrial("", 0, trial.arguments[4], True, 0.001, 2e-4, 11.0),
    "assistance_of_robot": _assisted,
    "compensated": lambda _: CompensationTrial(0.1, 10.0, 5.0, 0.1, 0.7, 8.0),
    "monitor_one_robot": _monitored,
    "fitted": _recorded,
}


def _with(**fields: Any) -> Change:
    return lambda result: result._replace(**fields)


def _tip(**errors: float) -> Change:
    return lambda arm: arm._replace(tip=arm.tip._replace(**errors)) if arm.network != PERFECT else arm


def _links(**errors: float) -> Change:
    def worse(arm: ArmTrial) -> ArmTrial:
        links = tuple(link._replace(ours=link.ours._replace(**errors)) for link in arm.links if link.ours)
        return arm if arm.network == PERFECT else arm._replace(links=links)

    return worse


def _each(field: str, **fields: Any) -> Change:
    return lambda result: result._replace(
        **{field: tuple(e._replace(**fields) for e in getattr(result, field))}
    )


def _assists(*rms: float) -> Change:
    return lambda tried: [each._replace(follows=tuple(_follow(one) for one in rms)) for each in tried]


def _poorly(report: Any) -> Any:
    worse = [SimpleNamespace(**(vars(one) | {"overall": 0.2})) for one in report.held_out]
    return SimpleNamespace(held_out=worse)


# Everything that is measured, broken.
BROKEN: Mapping[str, Mapping[str, Change]] = {
    "joint_trial": {
        "length": _with(ours_error_m=2e-3),
        "length in per cent": _with(ours_error_m=6e-3),
        "interval": _with(ours_sigma_m=0.02),
        "axis": _with(axis_error_deg=0.2),
    },
    "arm_trial": {
        "session": lambda arm: (
            arm._replace(why="lost", links=(), tip=None) if arm.network != PERFECT else arm
        ),
        "topology": lambda arm: (
            arm._replace(differences=("b is on a",), tip=None) if arm.network != PERFECT else arm
        ),
        "tip's place": _tip(position_m=5e-3),
        "tip's turn": _tip(orientation_deg=0.5),
        "links": _links(length_m=1e-3),
        "axes": _links(axis_deg=0.6),
        "robot's time": _with(robot_time_s=100.0),
        "processor's time": _with(identify_s=10.0),
    },
    "fault_trial": {"silence": _with(sigmas_off=(5.0, 5.0)), "another's name": _with(others=("b",))},
    "topology_trial": {"topology": _with(differences=("b is on a",))},
    "checks_of_one_robot": {
        "detection": _each("changed", located=False, size_error_m=None),
        "size": _each("changed", size_error_m=1e-3),
        "false alarms": _each("unchanged", false_alarm=True),
        "time": _each("changed", robot_time_s=100.0),
    },
    "regressor_trial": {
        "chunks": _with(chunks_us=30.0),
        "batch": _with(batch_us=5.0),
        "regressor": _with(difference=1e-6),
    },
    "inertia_trial": {
        "session": _with(why="lost"),
        "rank": _with(rank=19),
        "sigmas": _with(sigmas_off=(4.0,) * 20),
        "parameters": _with(largest=(0.1,) * 10),
        "torque": _with(held_out=0.1, with_true_chain=0.1, thesis=0.1),
        "chain": _with(with_true_chain=0.001),
        "bodies": _with(bodies=0.02),
        "mass matrix": _with(not_definite=1),
    },
    "reassembly_in_folder": {
        "agents": _with(difference=1e-6),
        "merging": _with(rank_merged=15),
        "deviations": _with(sigma_ratio=1.1),
    },
    "payload_trial": {
        "detection": _with(found=True, on_its_body=False),
        "mass": _with(mass_error=0.3),
        "centre": _with(com_error_m=0.05),
        "time": _with(motion_s=30.0),
    },
    "assistance_of_robot": {"gain": _assists(3.0, 2.0, 1.9), "mode": _assists(1.0, 2.0, 3.0)},
    "compensated": {
        "drift": _with(drift_deg=5.0),
        "weight": _with(guiding_n=7.0),
        "drift after guiding": _with(rest_deg=5.0),
    },
    "monitor_one_robot": {
        "detection": _each("trials", found="nothing", located=False, named_s=None),
        "kind": _each("trials", found="unexplained"),
        "place": _each("trials", located=False),
        "latency": _each("trials", named_s=20.0),
        "additional findings": _each("trials", false_alarms=1),
        "false alarms": _each("unchanged", alarms=3),
    },
    "fitted": {"torque": _poorly},
}


def result(case: Case, change: Change = lambda good: good) -> CaseResult:
    return concluded(case, [change(GOOD[trial.work.__name__](trial)) for trial in case.trials])


def barred(case: Case) -> list[str]:
    return [row.figure for row in result(case).summary.rows if row.limit is not None]


def missed(case: Case, change: Change) -> set[str]:
    return {row.figure for row in result(case, change).summary.rows if row.holds is False}


def every_bar() -> Iterator[Any]:
    for effort, cases in EFFORTS.items():
        for case in cases:
            for figure in barred(case):
                yield pytest.param(case, figure, id=f"{effort}: {case.name}: {figure}")


EVERY_CASE = [
    pytest.param(case, id=f"{effort}: {case.name}") for effort, all_ in EFFORTS.items() for case in all_
]


@pytest.mark.parametrize(("case", "figure"), list(every_bar()))
def test_every_bar_is_met_by_what_is_right_and_missed_by_what_is_broken(case: Case, figure: str) -> None:
    assert missed(case, lambda good: good) == set()
    broken = BROKEN[case.trials[0].work.__name__].values()
    assert any(figure in missed(case, change) for change in broken)


@pytest.mark.parametrize("case", EVERY_CASE)
def test_every_row_names_profile_and_knowledge(case: Case) -> None:
    # With the factory's gains the published figures say themselves that nothing is gained.
    assert barred(case) or "the factory's gains" in case.name
    assert all(row.profile and row.known for row in result(case).summary.rows)


@pytest.mark.parametrize(
    ("work", "what"), [(work, what) for work, changes in BROKEN.items() for what in changes]
)
@pytest.mark.parametrize("effort", EFFORTS)
def test_everything_that_breaks_is_seen_by_some_row(effort: str, work: str, what: str) -> None:
    cases = [case for case in EFFORTS[effort] if case.trials[0].work.__name__ == work]
    assert any(missed(case, BROKEN[work][what]) for case in cases)


@pytest.mark.parametrize("effort", EFFORTS)
@pytest.mark.parametrize(
    ("work", "change"),
    [
        ("joint_trial", _with(ours_error_m=1.3e-4)),
        ("arm_trial", _links(length_m=1.1e-3)),
        ("arm_trial", _tip(position_m=1.1e-3)),
    ],
)
def test_errors_beyond_the_physical_limit_miss_the_bar_over_all_cases(
    effort: str, work: str, change: Change
) -> None:
    cases = [case for case in EFFORTS[effort] if case.trials[0].work.__name__ == work]
    assert all(row.holds for row in over_all([result(case) for case in cases]) if "bound" in row.figure)
    assert [row.figure for row in over_all([result(case, change) for case in cases]) if row.holds is False]
