"""The benchmark of dynamics: what a bar is about reaches its row, and what misses it is seen to."""

from typing import Any

import numpy as np
import pytest

from sim.benchmark.case import Case, Summary, concluded
from sim.benchmark.cases.inertia import InertiaTrial
from sim.benchmark.cases.monitoring import Alarms, MonitoredSegments, MonitoringTrial
from sim.benchmark.cases.payload import PayloadTrial
from sim.benchmark.cases.regressor import RegressorTrial
from sim.benchmark.cases.suites import DYNAMIC_TRIALS, QUICK_DYNAMICS, dynamic_cases, full_dynamics
from sim.benchmark.row import Row
from sim.thesis.dynamics.torque_assistance import ON_MODULE, Follow, Gains
from sim.thesis.dynamics.torque_assistance_cases import Case as Combined
from sim.thesis.dynamics.torque_assistance_cases import Combination

CASES = {case.name: case for case in dynamic_cases(full_dynamics(), seed=0)}


def rows(name: str, *trials: Any) -> dict[str, Row]:
    summary: Summary = CASES[name].summarise(trials)
    found = {row.figure: row for row in summary.rows}
    assert len(found) == len(summary.rows)
    return found


def missed(found: dict[str, Row]) -> list[str]:
    return [figure for figure, row in found.items() if row.holds is False]


def test_the_quick_benchmark_has_every_case_and_says_where_it_does_less() -> None:
    quick = [case.name for case in dynamic_cases(QUICK_DYNAMICS, seed=0)]
    left = [name for name in CASES if not any(one.startswith(name) for one in quick)]
    # That nothing is taken for something is tried where there is time for it.
    assert left == ["a2085_06, no payload", "a2085_03, x5-uncalibrated, monitored"]
    assert all(name in CASES or name.endswith(", true model") for name in quick)


def test_the_quick_payloads_and_gravity_compensation_are_of_sessions_that_inertia_is_measured_in() -> None:
    quick = {case.name: case.trials[0] for case in dynamic_cases(QUICK_DYNAMICS, seed=0)}
    for profile, suffix in (("x5", ""), ("x5-uncalibrated", ", x5-uncalibrated")):
        inertia, payload = (
            quick[f"a2085_06, {name}"] for name in (f"{profile}, inertia", f"payload of 0.2 kg{suffix}")
        )
        assert payload.shares == inertia.shares != ""
        assert payload.arguments[:4] == inertia.arguments[:4]
        assert payload.arguments[-1] is True
        inertia, compensation = (
            quick[f"a2085_04, {profile}, {name}"] for name in ("inertia", "gravity compensation")
        )
        assert compensation.shares == inertia.shares != ""
        assert compensation.arguments[:2] == (inertia.arguments[2], inertia.arguments[1])
    assert len({trial.shares for trial in quick.values()} - {""}) == 6
    assert {trial.shares for case in CASES.values() for trial in case.trials} == {""}


def test_the_full_benchmark_monitors_for_an_hour_and_tries_everything_several_times() -> None:
    for profile in ("", "x5-uncalibrated, "):
        monitored = CASES[f"a2085_03, {profile}monitored"]
        drawn = [one for trial in monitored.trials for one in trial.arguments[0]]
        unchanged = [day for trial in monitored.trials for day in trial.arguments[1]]
        segment_s = {trial.arguments[3] for trial in monitored.trials}
        assert len(set(drawn)) == len(drawn) == 4 * 2 * DYNAMIC_TRIALS
        assert len(set(unchanged)) * segment_s.pop() == 3600.0
    assert len(CASES["a2085_06, x5, inertia"].trials) == DYNAMIC_TRIALS


def inertia(**changed: Any) -> InertiaTrial:
    good: dict[str, Any] = {
        "rank": 36,
        "designed_rank": 36,
        "sigmas_off": (0.5, -1.0, 2.0),
        "largest": (0.001, 0.002),
        "largest_sigma": (0.001, 0.002),
        "held_out": 0.007,
        "with_true_chain": 0.0065,
        "thesis": 0.01,
        "bodies": 0.0071,
        "poses": 10,
    }
    return InertiaTrial("a2085_06", "x5", 0, "")._replace(**(good | changed))


def test_a_session_that_did_not_come_to_its_end_is_counted() -> None:
    found = rows("a2085_06, x5, inertia", inertia(), inertia(why="module elbow was lost"))
    assert found["runs without inertia, of 2"].ours == 1.0
    assert found["held-out torque, worst [%]"].ours == pytest.approx(0.7)


def test_why_a_session_identified_no_inertia_is_said() -> None:
    trials = [inertia(), inertia(seed=7, why="module elbow was lost")]
    told = concluded(CASES["a2085_06, x5, inertia"], trials).failures
    assert told == ("seed 7: module elbow was lost",)


def test_the_rigid_arms_bar_is_the_tighter_one() -> None:
    limits = {
        name: rows(f"a2085_06, {name}, inertia", inertia())["held-out torque, worst [%]"].limit
        for name in ("rigid", "x5")
    }
    assert limits == {"rigid": 1.0, "x5": 3.0}


def test_a_payload_on_another_body_or_of_another_mass_misses() -> None:
    name = "a2085_06, payload of 0.2 kg"
    good = PayloadTrial("a2085_06", 0, True, True, 0.001, 2e-4, 11.0)
    assert missed(rows(name, good)) == []
    assert missed(rows(name, good._replace(mass_error=-0.04))) == ["mass, worst [%]"]
    assert missed(rows(name, good._replace(com_error_m=6e-3, motion_s=16.0))) == [
        "centre, worst [mm]",
        "motion, longest [s]",
    ]
    lost = rows(name, good._replace(found=False, on_its_body=False))
    assert lost["payloads not found, or on another body, of 1"].holds is False
    bare = rows("a2085_06, no payload", good)
    assert missed(bare) == ["payloads found where none is, of 1"]


def test_without_pinocchio_only_our_own_cost_is_judged() -> None:
    (name,) = (name for name in CASES if name.startswith("regressor"))
    assert len(rows(name, RegressorTrial(0.3, 0.6, 1.0, 3.0, 0.3, None, None))) == 1
    assert missed(rows(name, RegressorTrial(0.8, 1.0, 21.0, 3.0, 0.3, 3.0, 1e-11))) == [
        "in chunks of 50 [us a sample]",
        "difference from pinocchio's [relative]",
        "cost of a batch over pinocchio's loop",
    ]


def assisted(rms: tuple[float, float, float], unstable: str = "") -> Combination:
    nothing = np.empty((0, 1))
    first, second, third = (
        Follow(error, 0.0, 0.0, 0.0, words, nothing, nothing)
        for error, words in zip(rms, ("", "", unstable), strict=True)
    )
    return Combination(Combined("arm6", "", "all joints", Gains(4), ON_MODULE), (first, second, third))


def test_calculated_torque_must_help_where_it_is_stable() -> None:
    six = "assistance, six joints, strategy 4"
    assert missed(rows(six, [assisted((3.0, 2.0, 0.5))])) == []
    assert missed(rows(six, [assisted((3.0, 2.0, 1.0))])) == [
        "error by calculated torque over that without, most"
    ]
    thesis = "assistance, vertical, the thesis' gains"
    found = rows(thesis, [assisted((3.0, 2.0, 1.0)), assisted((1.0, 2.0, 3.0), "rings")])
    assert missed(found) == []
    assert found["unstable with it, of 2"].ours == 1.0
    assert "stable, and not the best of three modes, of 1" in missed(
        rows(thesis, [assisted((1.0, 3.0, 2.0))])
    )


def monitored(**changed: Any) -> MonitoringTrial:
    good = MonitoringTrial("payload", "payload", True, 0.5, 1.5, 0.2, 0.01, 0, 20.0, ())
    return good._replace(**changed)


def test_a_fifth_of_the_events_may_be_missed_and_of_few_none() -> None:
    name = "a2085_03, monitored"
    quiet = (Alarms(0, 3600.0),)

    def lost(missing: int, of: int) -> list[str]:
        events = (monitored(found="nothing"),) * missing + (monitored(),) * (of - missing)
        return missed(rows(name, MonitoredSegments(events, quiet)))

    assert lost(2, 10) == []
    assert lost(3, 10) == ["payload: missed or misplaced, of 10"]
    assert lost(1, 1) == ["payload: missed or misplaced, of 1"]


def test_every_case_is_named_once() -> None:
    names = [case.name for case in dynamic_cases(full_dynamics(), seed=0)]
    assert len(set(names)) == len(names)
    assert all(isinstance(case, Case) for case in CASES.values())
