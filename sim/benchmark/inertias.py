"""Arms that find out their inertia: base parameters, held-out torques, real bodies, and what IMUs add."""

from collections.abc import Sequence
from functools import partial
from statistics import median

from scipy.stats import binom, norm

from coordinator.plan import Plan
from sim.benchmark.arms import SHORTENED
from sim.benchmark.case import Case, Summary, Trial, trial_seed
from sim.benchmark.row import Row, count, largest, scaled
from sim.experiments.inertia_trial import LARGEST, InertiaTrial, inertia_trial, rigid_profile

ARMS = ("a2085_04", "a2085_06")
# What is asked of held-out torques, of a rigid arm and of one with friction, springs and a base that gives.
HELD_OUT_PERCENT = {"rigid": 1.0, "x5": 3.0}
SIGMAS = 3.0
LARGEST_PERCENT = 1.0
TRUE_CHAIN_RATIO = 1.2
BODIES_POINTS = 0.1
PLAN = Plan(
    excitation="designed", motions="designed", imu="calibrated", torque="calibrated", excitation_s=8.0
)
QUICK_PLAN = PLAN.model_copy(
    update=SHORTENED | {"mode": "whole", "excitation_motions": 3, "excitation_s": 4.0}
)
POSES, QUICK_POSES = 10_000, 1_000
_COST_S = {"a2085_04": 10.0, "a2085_06": 18.0}


def inertia_cases(trials: int, seed: int, shortened: bool = False) -> list[Case]:
    """Return one case for every arm, as good as rigid and with all that real ones do.

    `shortened`: all joints are explored at once, excitation is half as long, with a tenth of the poses.
    """
    plan, poses = (QUICK_PLAN, QUICK_POSES) if shortened else (PLAN, POSES)
    profiles = {"rigid": rigid_profile(), "x5": "x5"}
    cases = []
    for arm in ARMS:
        for label, noise in profiles.items():
            work = tuple(
                Trial(
                    inertia_trial,
                    (arm, noise, trial_seed(seed, arm, number), plan, poses, label),
                    0.5 * _COST_S[arm] if shortened else _COST_S[arm],
                )
                for number in range(trials)
            )
            name = f"{arm}, {label}, inertia"
            cases.append(Case(name, work, partial(_summary, name, label)))
    return cases


def _summary(case: str, label: str, trials: Sequence[InertiaTrial]) -> Summary:
    done = [trial for trial in trials if not trial.why]
    off = tuple(value for trial in done for value in trial.sigmas_off)
    rows = [
        count(case, "runs without inertia", [bool(trial.why) for trial in trials]),
        count(case, "runs with fewer parameters than there are", [t.rank < t.most_rank for t in done]),
        *_sigma_rows(case, off),
        *_largest_rows(case, done),
        *_torque_rows(case, label, done),
        count(case, "poses with a mass matrix that is not definite", _poses(done)),
        Row(case, "noise left in torques, encoders over IMUs", None, _median([t.gain for t in done])),
    ]
    return Summary(tuple(rows), off)


def _sigma_rows(case: str, off: Sequence[float]) -> list[Row]:
    """Return how many errors are beyond three sigmas; as many may be as of normal ones in 99 of 100 cases."""
    beyond = float(sum(abs(value) > SIGMAS for value in off))
    most = float(binom.isf(0.01, len(off), 2.0 * norm.sf(SIGMAS))) if off else None
    figure = f"base parameters known to 10 %, beyond {SIGMAS:.0f} sigma, of {len(off)}"
    return [
        Row(case, figure, None, beyond if off else None, None, most if off else 0.0),
        Row(case, "the same: worst error [sigma]", None, largest(off)),
    ]


def _largest_rows(case: str, done: Sequence[InertiaTrial]) -> list[Row]:
    """Return the errors of the largest ten: of those that noise allows to be known so well, and of all.

    Three standard deviations within the bar: of the others chance decides whether they keep it.
    """
    pairs = [pair for trial in done for pair in zip(trial.largest, trial.largest_sigma, strict=True)]
    allowed = [(error, sigma) for error, sigma in pairs if 3.0 * sigma < 0.01 * LARGEST_PERCENT]
    told = f"largest {LARGEST} that are known: noise tells to 1 %, share [%]"
    rows = [Row(case, told, None, 100.0 * len(allowed) / len(pairs) if pairs else None)]
    for what, chosen, limit in (
        ("largest ten, of those noise tells to 1 %", allowed, LARGEST_PERCENT),
        ("largest ten that are known", pairs, None),
    ):
        worst, claimed = (scaled(largest([pair[k] for pair in chosen]), 100.0) for k in range(2))
        rows.append(Row(case, f"{what}: worst error [%]", None, worst, claimed, limit))
    return rows


def _torque_rows(case: str, label: str, done: Sequence[InertiaTrial]) -> list[Row]:
    percent = {
        name: [100.0 * getattr(trial, name) for trial in done]
        for name in ("held_out", "with_true_chain", "thesis", "bodies")
    }
    ratios = [trial.held_out / trial.with_true_chain for trial in done]
    worse = [100.0 * (trial.bodies - trial.held_out) for trial in done]
    return [
        Row(
            case,
            "held-out torque, worst [%]",
            largest(percent["thesis"]),
            largest(percent["held_out"]),
            largest(percent["with_true_chain"]),
            HELD_OUT_PERCENT[label],
        ),
        Row(case, "the same over that with the true chain", None, _most(ratios), None, TRUE_CHAIN_RATIO),
        Row(case, "real bodies worse by [points]", None, _most(worse), None, BODIES_POINTS),
    ]


def _poses(done: Sequence[InertiaTrial]) -> list[bool]:
    return [k < trial.not_definite for trial in done for k in range(trial.poses)]


def _median(values: Sequence[float]) -> float | None:
    return median(values) if values else None


def _most(values: Sequence[float]) -> float | None:
    return max(values) if values else None
