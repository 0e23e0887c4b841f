"""The benchmarks of kinematics and of dynamics: their cases and efforts, and the coverage over all cases."""

from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import NamedTuple

from coordinator.excitation.plan import Motions
from sim.benchmark.case import Case, CaseResult
from sim.benchmark.cases.arm import LENGTHS, SHORTENED, TIP, arm_cases, arm_plan
from sim.benchmark.cases.gravity_compensation import compensation_cases
from sim.benchmark.cases.inertia import inertia_cases
from sim.benchmark.cases.joint import LENGTH_OF_ONE, joint_cases
from sim.benchmark.cases.link_change import link_change_cases
from sim.benchmark.cases.monitoring import monitoring_cases
from sim.benchmark.cases.network import network_cases
from sim.benchmark.cases.payload import payload_cases
from sim.benchmark.cases.reassembly import reassembly_cases
from sim.benchmark.cases.regressor import regressor_cases
from sim.benchmark.cases.staubli_tx40 import recorded_cases
from sim.benchmark.cases.topology import topology_cases
from sim.benchmark.cases.torque_assistance import assistance_cases
from sim.benchmark.row import Row, coverage, rms, widened
from sim.benchmark.sensor_faults import FAULTS, QUICK, fault_cases

KINEMATIC_TRIALS = 13
ALL = "all cases"
# The rms of errors over the physical limit; `Summary.over_bound`.
# A whole arm's bound knows how its links give, and uses travel too.
OVER_BOUND = {LENGTH_OF_ONE: 1.2, LENGTHS: 3.0, TIP: 1.5}


class KinematicEffort(NamedTuple):
    """Numbers of trials of the kinematic cases; `shortened`: arms move for a shorter time."""

    joints: int
    arms: int
    robots: int
    networks: int
    changed: int
    unchanged: int
    shortened: bool = False


QUICK_KINEMATICS = KinematicEffort(
    joints=1, arms=1, robots=1, networks=1, changed=1, unchanged=1, shortened=True
)


def full_kinematics(trials: int = KINEMATIC_TRIALS) -> KinematicEffort:
    """Return the effort that the bars are meant for, with that many trials a case."""
    return KinematicEffort(trials, trials, robots=200, networks=trials, changed=trials, unchanged=100)


def kinematic_cases(effort: KinematicEffort, seed: int, motions: Motions | None = None) -> list[Case]:
    """Return all cases, in the order in which they are reported; `motions`: see `arm_plan`."""
    calibrated = arm_plan("joint", "calibrated", motions)
    plan = calibrated.model_copy(update=SHORTENED) if effort.shortened else calibrated
    return [
        *joint_cases(effort.joints, seed),
        *arm_cases(effort.arms, seed, effort.shortened, motions),
        *topology_cases(effort.robots, seed, effort.shortened),
        *network_cases(effort.networks, seed, plan),
        *link_change_cases(effort.changed, effort.unchanged, seed, effort.shortened),
        *fault_cases(effort.arms, seed, QUICK if effort.shortened else tuple(FAULTS), effort.shortened),
    ]


def chosen(cases: Sequence[Case], pattern: str) -> list[Case]:
    """Return the cases whose name contains the pattern; * and ? are wildcards."""
    return [case for case in cases if fnmatch(case.name, f"*{pattern}*")]


def over_all(results: Sequence[CaseResult]) -> list[Row]:
    """Return the rows over all cases; none if no case claimed an interval."""
    off = [value for result in results for value in result.summary.sigmas_off]
    rows = [coverage(off)._replace(case=ALL)] if off else []
    over: dict[str, list[float]] = {}
    for result in results:
        for what, values in result.summary.over_bound.items():
            over.setdefault(what, []).extend(values)
    for what, values in over.items():
        # Other bars have room for chance already.
        limit = widened(OVER_BOUND[what], 3 * len(values)) if what == TIP else OVER_BOUND[what]
        figure = f"{what}, rms error over the bound, of {len(values)}"
        rows.append(Row(figure, rms(values), limit, bound=1.0)._replace(case=ALL))
    return rows


DYNAMIC_TRIALS = 5


class DynamicEffort(NamedTuple):
    """Numbers of trials of the dynamic cases; `shortened`: robots move for a shorter time.

    segments: of monitoring without any change, five minutes each.
    """

    inertias: int
    payloads: int
    reassemblies: int
    compensations: int
    monitorings: int
    segments: int
    shortened: bool = False


QUICK_DYNAMICS = DynamicEffort(1, 1, 1, 1, 1, 1, shortened=True)


def full_dynamics(trials: int = DYNAMIC_TRIALS) -> DynamicEffort:
    """Return the effort with that many trials a case, and an hour of monitoring without any change."""
    return DynamicEffort(trials, trials, trials, trials, monitorings=2 * trials, segments=12)


def dynamic_cases(effort: DynamicEffort, seed: int, tx40: Path | None = None) -> list[Case]:
    """Return all cases, in the order in which they are reported; tx40: folder of a real arm's recording."""
    return [
        *regressor_cases(seed),
        *inertia_cases(effort.inertias, seed, effort.shortened),
        *reassembly_cases(effort.reassemblies, seed),
        *payload_cases(effort.payloads, seed, effort.shortened),
        *assistance_cases(seed, effort.shortened),
        *compensation_cases(effort.compensations, seed, effort.shortened),
        *monitoring_cases(effort.monitorings, effort.segments, seed, effort.shortened),
        *([] if tx40 is None else recorded_cases(tx40)),
    ]
