"""Motions of a session: the plan's, or motions designed from each joint's recorded load."""

from collections.abc import Callable, Sequence

import numpy as np

from coordinator.excitation.joint_limits import (
    JointLimits,
    NoExcitation,
    joint_limits,
    least_accel_rad_s2,
    likely_inertia_kg_m2,
    measured_load,
)
from coordinator.excitation.multisine import simultaneous_patterns
from coordinator.excitation.plan import Plan
from coordinator.excitation.single_joint import (
    LIKELY_RADIUS_M,
    JointMotions,
    JointTask,
    design_joint,
    next_sine,
    predicted_sigma_m,
)
from coordinator.recording.recording import Recording
from module_agent.model.catalogue import ModuleType
from module_agent.model.imu_prior import IMU_PRIORS
from module_agent.wire.messages import (
    ConstantMotion,
    MotionRecord,
    MultiSine,
    OtherMotion,
    Pattern,
    Rest,
    WindowedSine,
)

# A session of designed motions: just under 10 s per joint, less the time to discover and check the modules,
# to rest and to move all joints at once.
DESIGNED_JOINT_S = 9.8
AROUND_S = 19.0
# In less time no designed motion fits: travel, settling and ramps take most of it.
MIN_JOINT_S, MAX_JOINT_S = 5.25, 9.0
# Requests for all modules' estimates, and the modules' ticks between motions.
ANSWERS_S = 0.3
# A repetition must reduce the predicted sigma by this share.
MIN_GAIN_SHARE = 0.05
MAX_MOTIONS = 8
# How far a slow trial moves every joint to either side.
TRIAL_RAD = 0.08
# Rest of a run that moves all joints at once, for speed: 1 s determines the gyros' biases to 0.1 mrad/s.
SIMULTANEOUS_REST_S = 1.0


def resting(plan: Plan) -> Rest:
    """Return the motion of modules that listen at rest."""
    longest_s = SIMULTANEOUS_REST_S if plan.mode == "simultaneous" else plan.rest_s
    return Rest(duration_s=min(longest_s, plan.rest_s))


def joint_budget_s(plan: Plan, joints: int) -> float:
    """Return how long exploring one of so many joints by designed motions may take."""
    return plan.joint_s or float(np.clip(DESIGNED_JOINT_S - AROUND_S / joints, MIN_JOINT_S, MAX_JOINT_S))


class MotionChoice:
    """Chooses motions; `serials` returns the joints to move, `kind` the type of a module."""

    def __init__(
        self,
        plan: Plan,
        recording: Recording,
        serials: Callable[[], Sequence[str]],
        kind: Callable[[str], ModuleType],
    ):
        self._plan = plan
        self._serials = serials
        self._recording = recording
        self._kind = kind

    def slow(self, serial: str) -> ConstantMotion:
        """Return a joint's slow motion, designed for the likely load, before it is measured."""
        designed = self._designed(serial, self._unmoved_limits(serial)) if self._designs() else None
        return designed.constant if designed is not None else self._plan.constant()

    def fast(self, serial: str, slow: MotionRecord) -> WindowedSine:
        """Return a joint's fast motion, designed for the load measured in its slow motion."""
        if not self._designs() or not isinstance(slow.pattern, ConstantMotion):
            return self._plan.sine(self._kind(serial))
        designed = self._designed(serial, self._moved_limits(serial, slow), slow.pattern)
        return designed.sine if designed is not None else self._plan.sine(self._kind(serial))

    def again(self, serial: str, done: Sequence[MotionRecord]) -> WindowedSine | None:
        """Return one more fast motion if the plan's precision needs one and it helps enough; else None."""
        wanted_mm = self._plan.precision_mm
        if wanted_mm is None or len(done) >= MAX_MOTIONS:
            return None
        task = self._task(serial, self._moved_limits(serial, done[0]))
        patterns = _patterns(done)
        sigma = predicted_sigma_m(task, patterns)
        more = next_sine(task, patterns, 2.0 * self._plan.sine_centre_s)
        if sigma <= 1e-3 * wanted_mm or more is None:
            return None
        return more if predicted_sigma_m(task, [*patterns, more]) < (1.0 - MIN_GAIN_SHARE) * sigma else None

    def predicted_mm(self, serial: str, done: Sequence[MotionRecord]) -> float:
        """Return the predicted sigma of the radius after these motions [mm]."""
        task = self._task(serial, self._moved_limits(serial, done[0]))
        return 1e3 * predicted_sigma_m(task, _patterns(done))

    def simultaneous(self) -> dict[str, MultiSine]:
        """Return the motions of all joints at once."""
        limits = {s: self._unmoved_limits(s) for s in self._serials()}
        return simultaneous_patterns(limits, self._plan.home_rad, self._plan.simultaneous_duration_s)

    # ------------------------------------------------------------------ what is known

    def _designs(self) -> bool:
        return self._plan.motions == "optimised"

    def _designed(
        self, serial: str, limits: JointLimits, slow: ConstantMotion | None = None
    ) -> JointMotions | None:
        """Return the best motions; None if none fits into the time."""
        try:
            return design_joint(self._task(serial, limits), slow)
        except NoExcitation:
            return None

    def _task(self, serial: str, limits: JointLimits) -> JointTask:
        force = self._recording.rest_rows(serial)["accel_m_s2"].astype(float).mean(axis=0)
        return JointTask(
            limits,
            float(force[2] / np.linalg.norm(force)),
            IMU_PRIORS[self._plan.imu],
            self._plan.home_rad,
            self._plan.travel_speed_rad_s,
            self._plan.settle_s,
            joint_budget_s(self._plan, len(self._serials())) - 2.0 * ANSWERS_S,
            self._radius_m(serial),
        )

    def _radius_m(self, serial: str) -> float:
        """Return the largest estimated radius about this joint; a likely one before there is any estimate."""
        radii = [
            estimate.best.distance_m
            for (joint, observer), estimates in self._recording.estimates.items()
            for estimate in estimates.values()
            if joint == serial and observer != serial and estimate.best is not None
        ]
        return max(radii, default=LIKELY_RADIUS_M)

    def _unmoved_limits(self, serial: str) -> JointLimits:
        return self._limits(serial, likely_inertia_kg_m2([self._kind(s) for s in self._serials()]))

    def _moved_limits(self, serial: str, slow: MotionRecord) -> JointLimits:
        rows = self._recording.rows(serial, slow.start_row, slow.end_row or slow.start_row)
        t_ns = rows["t_ns"].astype(np.int64)
        if len(rows) < 2 or t_ns[-1] <= t_ns[0]:
            # Another module answers to this serial and has not made the motion, or its clock stood or went
            # back: the session finds that out.
            return self._unmoved_limits(serial)
        rate_hz = 1e9 * (len(rows) - 1) / float(t_ns[-1] - t_ns[0])
        load = measured_load(rows["position_rad"].astype(float), rows["effort_nm"].astype(float), rate_hz)
        return self._limits(serial, load.at_most_kg_m2)

    def _limits(self, serial: str, inertia_kg_m2: float) -> JointLimits:
        rest_torque_nm = float(self._recording.rest_rows(serial)["effort_nm"].astype(float).mean())
        limits = joint_limits(self._kind(serial), rest_torque_nm, inertia_kg_m2)
        least = least_accel_rad_s2(len(self._serials()))
        return limits._replace(accel_rad_s2=max(limits.accel_rad_s2, least))


def _patterns(done: Sequence[MotionRecord]) -> list[Pattern]:
    return [record.pattern for record in done if not isinstance(record.pattern, OtherMotion)]
