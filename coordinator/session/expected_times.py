"""How long what is left of a session takes, by its plan and the modules' types.

Steps are named as in the journal. It is the robot's time, without what shows only as it goes on: motions that
are repeated, a poor network, and the computation at the end.
"""

from collections.abc import Collection, Mapping, Sequence

from coordinator.excitation.multisine import simultaneous_duration_s
from coordinator.excitation.plan import Plan
from coordinator.excitation.segment import RobotMotion
from coordinator.session.motion_selection import ANSWERS_S, TRIAL_RAD, joint_budget_s, resting
from module_agent.control.waveform import duration_s
from module_agent.model.catalogue import ModuleType
from module_agent.wire.messages import GoTo, Pattern

# A motion begins with its acknowledgement, and that it has ended is noticed within a poll or two.
MOTION_S = 0.05
# Poses of designed motions are drawn within the plan's reach; the farthest joint goes most of it.
POSE_SHARE = 0.8


class ExpectedTimes:
    """Durations [s] of the steps that are left of a session under a plan.

    kinds: the modules' types by serial. away_rad: how far the farthest joint is from home as it begins.
    done: steps that a resumed session need not repeat.
    """

    def __init__(
        self, plan: Plan, kinds: Mapping[str, ModuleType], away_rad: float, done: Collection[str] = ()
    ):
        self._plan = plan
        self._kinds = kinds
        self._done = done
        way_s = self._journey(away_rad)
        steps = {"trial": self._trial(away_rad)} if plan.trial_speed_rad_s is not None else {}
        steps |= {"home": way_s if not steps else self._journey(0.0), "rest": self._motion(resting(plan))}
        steps |= self._exploration() | (self._excitation() if plan.dynamics else {})
        steps["back"] = way_s - plan.settle_s
        self._left: dict[str, float] = {}
        self._add(steps)

    @property
    def left_s(self) -> float:
        """How long the steps that are left take."""
        return sum(self._left.values())

    def over(self, step: str) -> None:
        """Note that a step is over."""
        self._left.pop(step, None)

    def explore(self, serials: Sequence[str]) -> None:
        """Note that some joints are explored one by one, too."""
        self._add({f"explore/{serial}": self._joint(serial) for serial in serials})

    def excite(self, motions: Sequence[RobotMotion], serials: Sequence[str]) -> None:
        """Note how the joints are excited: all by `motions`, of which the last is held out, or one by one."""
        self._left = {"back": self._left["back"]}
        self._add(self._one_by_one(serials) if not motions else {})
        purposes = ["dynamic"] * (len(motions) - 1) + ["held_out"]
        self._add({f"{purposes[k]}/{k}": self._designed(motion) for k, motion in enumerate(motions)})

    def _add(self, steps: Mapping[str, float]) -> None:
        self._left |= {step: taken_s for step, taken_s in steps.items() if step not in self._done}

    # ------------------------------------------------------------------ steps

    def _exploration(self) -> dict[str, float]:
        plan = self._plan
        whole_s = plan.simultaneous_duration_s or simultaneous_duration_s(len(self._kinds))
        whole = {"explore": MOTION_S + whole_s}
        if plan.mode == "simultaneous":
            return whole
        one_by_one = {f"explore/{serial}": self._joint(serial) for serial in self._kinds}
        return one_by_one | (whole if plan.motions == "optimised" and not plan.topology_only else {})

    def _joint(self, serial: str) -> float:
        plan, slow = self._plan, self._plan.constant()
        if plan.motions == "optimised":
            return joint_budget_s(plan, len(self._kinds))
        aside_rad = 0.5 * slow.velocity_rad_s * (slow.duration_s + slow.ramp_s)
        motions: list[Pattern] = [slow] if plan.topology_only else [slow, plan.sine(self._kinds[serial])]
        return 2.0 * self._journey(aside_rad) + sum(self._motion(one) + ANSWERS_S for one in motions)

    def _excitation(self) -> dict[str, float]:
        plan = self._plan
        if plan.excitation != "d-optimal":
            return self._one_by_one(tuple(self._kinds))
        way_s = self._journey(POSE_SHARE * plan.excitation_reach_rad)
        each = MOTION_S + plan.excitation_s + 2.0 * way_s
        return {f"dynamic/{number}": each for number in range(plan.excitation_motions + 1)}

    def _one_by_one(self, serials: Sequence[str]) -> dict[str, float]:
        motions = {"excite": self._plan.dynamic, "held_out": self._plan.held_out}
        return {
            f"{step}/{serial}": self._motion(motion(self._kinds[serial])) + self._journey(0.0)
            for step, motion in motions.items()
            for serial in serials
        }

    def _designed(self, motion: RobotMotion) -> float:
        away_rad = max(abs(q - self._plan.home_rad) for q in motion.pose_rad.values())
        return 2.0 * self._journey(away_rad) + max(self._motion(one) for one in motion.patterns.values())

    def _trial(self, away_rad: float) -> float:
        speed = self._plan.trial_speed_rad_s
        each = 2.0 * self._journey(TRIAL_RAD, speed) + self._journey(2.0 * TRIAL_RAD, speed)
        return self._journey(away_rad, speed) + len(self._kinds) * each

    def _journey(self, way_rad: float, speed_rad_s: float | None = None) -> float:
        """Return how long joints take over a way, and to come to rest."""
        speed = speed_rad_s or self._plan.travel_speed_rad_s
        return self._motion(GoTo(target_rad=way_rad, max_speed_rad_s=speed)) + self._plan.settle_s

    def _motion(self, pattern: Pattern) -> float:
        return MOTION_S + duration_s(pattern, 0.0)
