"""Motions are the plan's, or designed by what rest and slow motion have shown of a joint."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from coordinator.recording.recording import Recording
from coordinator.session.motion_selection import MotionChoice
from module_agent.control.waveform import duration_s, waveform
from module_agent.model.catalogue import CATALOGUE
from module_agent.wire.feedback_rows import ROW
from module_agent.wire.messages import ConstantMotion, MotionRecord, Pattern, Rest, WindowedSine

SERIALS = ("A", "B", "C", "D")
REST, SLOW, FAST = (0, 250), (1000, 1400), (2000, 2001)


def record(pattern: Pattern, rows: tuple[int, int]) -> MotionRecord:
    return MotionRecord(
        motion_id=1,
        pattern=pattern,
        outcome="done",
        start_ns=0,
        start_row=rows[0],
        end_row=rows[1],
        origin_rad=0.0,
    )


class RecordedJoint(Recording):
    """A recording of joints that hold `rest_nm` at rest and move `inertia`, with level axes."""

    def __init__(self, inertia: float, slow: ConstantMotion | None = None, rest_nm: float = 0.5):
        super().__init__()
        rest = record(Rest(duration_s=1.0), REST)
        self.journal = [
            SimpleNamespace(what="motion", purpose="rest", serial=s, boot=0, motion=rest) for s in SERIALS
        ]
        self._inertia, self._slow, self._rest_nm = inertia, slow, rest_nm

    def rows(self, serial: str, first: int, end: int) -> "np.ndarray[Any, Any]":
        rows = np.zeros(end - first, dtype=ROW)
        rows["t_ns"] = 4_000_000 * np.arange(first, end)
        rows["accel_m_s2"] = (9.81, 0.0, 0.0)
        rows["effort_nm"] = self._rest_nm
        if self._slow is not None and first == SLOW[0]:
            t = np.minimum(0.004 * np.arange(end - first), duration_s(self._slow, 0.0))
            moved = waveform(self._slow, 0.0, t)
            rows["position_rad"] = moved.offset_rad
            rows["effort_nm"] += self._inertia * np.gradient(moved.velocity_rad_s, 0.004)
        return rows


def choice(plan: Plan, recorded: RecordedJoint, kind: str = "X5-4") -> MotionChoice:
    recording: Any = recorded
    return MotionChoice(plan, recording, lambda: SERIALS, lambda serial: CATALOGUE[kind])


def fast_of(inertia: float, plan: Plan) -> WindowedSine:
    slow = choice(plan, RecordedJoint(inertia)).slow("A")
    recorded = RecordedJoint(inertia, slow)
    return choice(plan, recorded).fast("A", record(slow, SLOW))


def test_the_plan_s_own_motions_are_the_thesis() -> None:
    plan = Plan()
    chosen = choice(plan, RecordedJoint(0.1))
    assert chosen.slow("A") == plan.constant()
    assert chosen.fast("A", record(plan.constant(), SLOW)) == plan.sine(CATALOGUE["X5-4"])
    assert chosen.again("A", [record(plan.constant(), SLOW)]) is None


def test_a_joint_that_carries_more_is_accelerated_less() -> None:
    plan = Plan(motions="optimised", imu="calibrated")
    light, heavy = fast_of(0.05, plan), fast_of(3.0, plan)

    def peak(sine: WindowedSine) -> float:
        return sine.amplitude * (2 * np.pi * sine.frequency_hz) ** 2

    assert peak(heavy) < 0.7 * peak(light)


@pytest.mark.parametrize("joints", [1, 2, 3, 4, 16])
def test_a_robot_of_any_size_has_the_time_for_designed_motions(joints: int) -> None:
    serials = [chr(ord("A") + k) for k in range(joints)]
    recorded = RecordedJoint(0.1)
    recorded.journal = [
        SimpleNamespace(
            what="motion", purpose="rest", serial=s, boot=0, motion=record(Rest(duration_s=1.0), REST)
        )
        for s in serials
    ]
    recording: Any = recorded
    plan = Plan(motions="optimised")
    chosen = MotionChoice(plan, recording, lambda: serials, lambda serial: CATALOGUE["X5-4"])
    assert chosen.slow("A") != plan.constant()


def test_without_time_for_a_designed_motion_the_standard_one_is_used() -> None:
    plan = Plan(motions="optimised", joint_s=1.5)
    chosen = choice(plan, RecordedJoint(0.1))
    assert chosen.slow("A") == plan.constant()
    assert chosen.fast("A", record(plan.constant(), SLOW)) == plan.sine(CATALOGUE["X5-4"])


@pytest.mark.parametrize("wanted_mm", [5.0, 0.05])
def test_motions_are_repeated_until_the_precision_is_reached_or_more_does_not_help(wanted_mm: float) -> None:
    plan = Plan(motions="optimised", imu="calibrated", precision_mm=wanted_mm)
    slow = choice(plan, RecordedJoint(0.1)).slow("A")
    chosen = choice(plan, RecordedJoint(0.1, slow))
    done = [record(slow, SLOW), record(chosen.fast("A", record(slow, SLOW)), FAST)]
    first_mm = chosen.predicted_mm("A", done)
    while (more := chosen.again("A", done)) is not None:
        done.append(record(more, FAST))
    reached_mm = chosen.predicted_mm("A", done)
    if wanted_mm > first_mm:
        assert len(done) == 2
    else:
        assert len(done) > 2
        assert reached_mm < first_mm
        assert reached_mm <= wanted_mm or len(done) == 8


def test_simultaneous_motions_exist_for_any_load() -> None:
    # 2.5 Nm is all that this type has: what holds itself can be moved a little all the same.
    strained = choice(Plan(mode="simultaneous"), RecordedJoint(0.1, rest_nm=2.4), "X5-1").simultaneous()
    assert set(strained) == set(SERIALS)
    easy = choice(Plan(mode="simultaneous"), RecordedJoint(0.1), "X5-1").simultaneous()
    for serial in SERIALS:
        assert strained[serial].sines[1].amplitude_rad <= easy[serial].sines[1].amplitude_rad


@pytest.mark.parametrize("tick_ns", [0, -4_000_000])
def test_a_clock_that_stood_or_went_back_in_the_slow_motion_leaves_the_load_at_what_is_likely(
    tick_ns: int,
) -> None:
    class Stood(RecordedJoint):
        def rows(self, serial: str, first: int, end: int) -> "np.ndarray[Any, Any]":
            rows = super().rows(serial, first, end)
            if first == SLOW[0]:
                rows["t_ns"] = 4_000_000_000 + tick_ns * np.arange(end - first)
            return rows

    plan = Plan(motions="optimised", imu="calibrated")
    slow = choice(plan, RecordedJoint(3.0)).slow("A")
    fast = choice(plan, Stood(3.0, slow)).fast("A", record(slow, SLOW))
    unmeasured = choice(plan, RecordedJoint(3.0)).fast("A", record(slow, (SLOW[0], SLOW[0] + 1)))
    assert fast == unmeasured != fast_of(3.0, plan)
