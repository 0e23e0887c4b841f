"""Dead, stuck, saturated and jumping sensors, found in the samples of each column before anything is fitted.

What noise and motion must change, but does not, is stuck; a reading that stays at its extreme is saturated; a
position that jumps between two samples, and a clock that leaps while that of the session goes on, are so
without any model of the robot.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import erf

from coordinator.identification.finding import UNUSABLE, Finding, Sickness, motion_of
from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import ModuleRecord, Recording
from coordinator.synchronisation.clock_steps import LEAP_NS, clocks_that_stood, leapt
from module_agent.model.catalogue import GRAVITY_M_S2
from module_agent.model.chain import Array
from module_agent.model.imu_prior import ACCEL_BIAS_SIGMA_M_S2
from module_agent.signals.filtering import NS_PER_S
from module_agent.wire.feedback_rows import ROW, Rows

# A column that reads the same for this long, and for as many samples, although there is noise. Of a real
# X5-1's gyro two readings in a row are alike for every second sample: 60 in a row once in 1e18.
STUCK_S, STUCK_SAMPLES = 0.4, 60
# So often chance makes as many readings in a row alike where the digits are coarse against the noise.
ONE_IN = 1e7
# Noise of a sample [rad/s, m/s^2] above which readings are not exact: a sixth of what a real X5-1's log has.
NOISY = (1e-4, 1.5e-3)
# A sensor at the end of its range reads the same extreme this often in a row, this many of its noise's
# standard deviations away from its median.
CLIPPED_SAMPLES, CLIPPED_SIGMAS = 8, 30.0
# And the swing that it cuts off is larger than this many times its noise or its last digit.
CUT_OFF = 5.0
# A joint turns by this much while its encoder or effort is said to be stuck.
TURNED_RAD = 0.05
# A joint that turned by less than this share of its command was held, or its motor failed meanwhile.
MIN_FOLLOWED = 0.2
# It halted where that is so for this long while it was to turn by so much: what lasts for 0.75 s is found,
# wherever it begins. Joints follow their commands within the last of these.
HALTED_S, HALTED_RAD, FOLLOWED_RAD = 0.5, 0.1, 0.02
# Friction holds a joint, too, where its command reverses: until the position error is the one at which it
# turns. Only an error this many times the largest usual one of a turning joint says that more holds it.
# Of 510 healthy motions of arms of four and six joints, stiff and soft, the most is 1.11 times. A joint turns
# if it is faster than this, over this time, and is known to turn by as many samples.
STICKING, TURNS_RAD_S, TURNS_S, TURNING_SAMPLES = 1.25, 0.05, 0.05, 25
# A position that changes by this much from one sample to the next, and neither before nor after it.
JUMP_RAD = 0.02
# Steps between rows of this many usual ones are long.
LONG_TICKS = 3.0
# The specific force at rest is that of gravity within this share, many times what any accelerometer is off.
GRAVITY_SHARE = 0.25
_IMU: tuple[tuple[str, str, float, Sickness, Sickness], ...] = (
    ("gyro_rad_s", "rad/s", NOISY[0], "gyro_stuck", "gyro_saturated"),
    ("accel_m_s2", "m/s^2", NOISY[1], "accelerometer_stuck", "accelerometer_saturated"),
)
_NAMES = {"gyro_rad_s": "its gyro", "accel_m_s2": "its accelerometer"}
WHOLE = "the recording"


class Run(NamedTuple):
    """Samples `start` up to and without `end` that are all alike."""

    start: int
    end: int

    @property
    def length(self) -> int:
        """How many samples these are."""
        return self.end - self.start


def runs(values: Array, longest: int = 1) -> list[Run]:
    """Return the stretches of values (m,) of at least `longest` samples in which no one differs."""
    changed = np.flatnonzero(values[1:] != values[:-1]) + 1
    edges = np.concatenate([[0], changed, [len(values)]])
    long = np.flatnonzero(np.diff(edges) >= longest)
    return [Run(int(edges[k]), int(edges[k + 1])) for k in long]


def sample_noise(values: Array) -> Array:
    """Return the standard deviation of the noise of single samples (m, ...), by third differences.

    A smooth motion hardly shows in them, and a stretch that is stuck not at all, as it is the upper quartile.
    """
    if len(values) < 8:
        return np.zeros(values.shape[1:])
    third = np.abs(np.diff(values, n=3, axis=0))
    # The upper quartile of |N(0, 20 sigma^2)| is 1.15 sigma sqrt(20).
    return np.asarray(np.quantile(third, 0.75, axis=0) / (1.15 * 20.0**0.5))


def sensor_findings(recording: Recording, serials: Sequence[str]) -> tuple[Finding, ...]:
    """Return the modules of a recording whose sensors or clocks are sick whatever the robot is like.

    serials: the modules that took part. One that did not may hold its joint: if its encoder jumps, it turns.
    """
    silent = [s for s in serials if s not in recording.modules or not len(_all_rows(recording.modules[s]))]
    heard = [s for s in serials if s not in silent]
    rows = {s: _all_rows(recording.modules[s]) for s in heard}
    beside = {s: _all_rows(module) for s, module in recording.modules.items() if s not in serials}
    whole = recording.latest_motions("whole", "repeat")
    # Steps that were done again count as they were done last.
    later = {(e.step, e.serial): e for e in recording.motions("dynamic", "held_out")}.values()
    events = [*recording.latest_motions("constant", "windowed_sine", "whole"), *later]
    return (
        *(_silent(s) for s in silent),
        *_inertial(rows, {s: recording.rest_rows(s) for s in heard}),
        *(one for s in heard for one in _gravity(s, recording.rest_rows(s)["accel_m_s2"].astype(float))),
        *(one for s in heard for one in _joint(s, [e for e in events if e.serial == s], recording)),
        *(one for s in heard for one in _halts(s, [*whole, *later], events, recording)),
        *(one for s, own in (rows | beside).items() for one in _jumps(s, own)),
        *_clocks(recording, rows),
        *_not_finite(recording, serials),
    )


def unusable(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return the serials of modules nothing of which can be used for the chain, sorted."""
    return tuple(sorted({f.serial for f in findings if f.serious and f.kind in UNUSABLE}))


def _all_rows(module: ModuleRecord) -> Rows:
    return module.rows.rows(module.rows.first_row, module.rows.end_row)


def _silent(serial: str) -> Finding:
    remedy = "the recording is damaged, or the module never sent any"
    return Finding(
        serial, WHOLE, "the number of its rows", 0.0, 1.0, np.inf, "", remedy, "messages_missing", True
    )


def _inertial(rows: dict[str, Rows], rests: dict[str, Rows]) -> Iterable[Finding]:
    """Yield stuck and saturated axes of IMUs, if readings at rest have noise, so that equal ones tell."""
    fresh, rest = ({s: _fresh(one) for s, one in some.items()} for some in (rows, rests))
    for field, unit, noisy, stuck_kind, saturated_kind in _IMU:
        noise = {s: sample_noise(one[field].astype(float)) for s, one in fresh.items()}
        resting = [sample_noise(one[field].astype(float)) > noisy for one in rest.values()]
        if not resting or np.mean(resting) < 1.0 / 3.0:
            continue
        by_chance = chance_repeats([one[field] for one in rest.values()])
        for serial, one in fresh.items():
            step_s = _step_s(one["imu_t_ns"])
            least = max(STUCK_SAMPLES, by_chance, round(STUCK_S / step_s) if step_s else 0)
            for axis in range(3):
                values = one[field][:, axis].astype(float)
                what = f"{_NAMES[field]} along {'xyz'[axis]}"
                least_noise = max(float(noise[serial][axis]), noisy)
                clipped = _clipped(values, least_noise)
                stuck = max(runs(values, least), key=lambda run: run.length, default=None)
                if clipped is not None:
                    yield _at_the_end(serial, what, clipped, values, least_noise, unit, saturated_kind)
                elif stuck is not None:
                    yield _same_for(serial, what, stuck, step_s, stuck_kind)


def _fresh(rows: Rows) -> Rows:
    """Return the rows in which the IMU's readings are new."""
    return rows[np.unique(rows["imu_t_ns"], return_index=True)[1]]


def chance_repeats(rests: Sequence[Array]) -> int:
    """Return how many readings in a row chance makes alike once in `ONE_IN`, of sensors at rest (m, 3) each.

    With noise of r digits two readings in a row differ in 2 r / sqrt(pi) of all cases, wherever between two
    digits the true value is; where it is midway, a reading is another one in erfc(1 / sqrt(8) r) of them
    only. Axes that never change are left out.
    """
    differ = [np.mean(one[1:] != one[:-1], axis=0) for one in rests if len(one) > 1]
    changing = [share for own in differ for share in own if share > 0.0]
    digits = float(np.mean(changing)) * np.sqrt(np.pi) / 2.0 if changing else 1.0
    alike = float(erf(1.0 / (np.sqrt(8.0) * digits)))
    # Readings that hardly ever change tell nothing by being alike.
    return math.ceil(-math.log(ONE_IN) / math.log(min(max(alike, 1e-9), 1.0 - 1e-9)))


def _at_the_end(
    serial: str, what: str, clipped: float, values: Array, noise: float, unit: str, kind: Sickness
) -> Finding:
    """Return the finding of a column that stays at an extreme."""
    middle, remedy = float(np.median(values)), "the sensor is at the end of its range"
    text, away = f"the largest reading of {what}, again and again,", abs(clipped - middle) / noise
    return Finding(serial, WHOLE, text, clipped, middle, away, unit, remedy, kind, True)


def _gravity(serial: str, accel_m_s2: Array) -> Iterable[Finding]:
    """Yield an accelerometer that does not read gravity at rest (m, 3)."""
    if not len(accel_m_s2):
        return
    force = float(np.linalg.norm(np.median(accel_m_s2, axis=0)))
    if abs(force - GRAVITY_M_S2) > GRAVITY_SHARE * GRAVITY_M_S2:
        yield Finding(
            serial,
            "its rest",
            "the specific force",
            force,
            GRAVITY_M_S2,
            abs(force - GRAVITY_M_S2) / ACCEL_BIAS_SIGMA_M_S2,
            "m/s^2",
            "an axis of the accelerometer is dead, or saturated",
            "accelerometer_contradicts",
            True,
        )


def _same_for(serial: str, what: str, run: Run, step_s: float, kind: Sickness) -> Finding:
    """Return the finding of a column that reads the same for a while, in which noise alone changes it."""
    text = f"the time for which {what} reads exactly the same"
    remedy = "the sensor is dead or stuck"
    return Finding(
        serial, WHOLE, text, run.length * step_s, step_s, float(run.length), "s", remedy, kind, True
    )


def _clipped(values: Array, noise: float) -> float | None:
    """Return the extreme at which values (m,) are cut off, far away from their median; None if they are not.

    The top of a smooth swing is flat, too, within the step of its digits: it is cut off only where the slopes
    before and after the flat part say that the swing would have gone well beyond it.
    """
    middle, steps = float(np.median(values)), np.abs(np.diff(values))
    digit = float(steps[steps > 0.0].min(initial=np.inf))
    for extreme in (float(values.max()), float(values.min())):
        at = values == extreme
        if abs(extreme - middle) > CLIPPED_SIGMAS * noise and np.count_nonzero(at) >= CLIPPED_SAMPLES:
            flat = [run for run in runs(at.astype(float), CLIPPED_SAMPLES) if at[run.start]]
            if any(_cut_off(values, run) > CUT_OFF * max(noise, digit) for run in flat):
                return extreme
    return None


def _cut_off(values: Array, flat: Run) -> float:
    """Return how much of a swing a flat part of values (m,) has cut off, by the slopes at its ends.

    The top of a parabola is a quarter of its chord times the slope at the chord's ends above it.
    """
    reach = max(4, flat.length // 4)
    before, after = values[max(flat.start - reach, 0) : flat.start + 1], values[flat.end - 1 :][: reach + 1]
    slopes = [abs(float(one[-1] - one[0])) / (len(one) - 1) for one in (before, after) if len(one) > 1]
    return float(np.mean(slopes)) * flat.length / 4.0 if slopes else 0.0


def _step_s(t_ns: NDArray[np.int64]) -> float:
    return float(np.median(np.diff(t_ns))) / NS_PER_S if len(t_ns) > 1 else 0.0


def _joint(serial: str, events: Sequence[JournalEvent], recording: Recording) -> Iterable[Finding]:
    """Yield an encoder and an effort that stay while the joint's motor turns, in the joint's own motions."""
    gear_ratio = recording.module_type(serial).gear_ratio if recording.modules[serial].info else np.inf
    found: set[Sickness] = set()
    for event in events:
        rows = _rows_of(event, recording)
        step_s = _step_s(rows["t_ns"].astype(np.int64))
        motor = np.cumsum(rows["motor_velocity_rad_s"].astype(float)) * step_s / gear_ratio
        turned_by: tuple[tuple[str, str, Array, Sickness], ...] = (
            ("position_rad", "its encoder", motor, "encoder_stuck"),
            ("effort_nm", "its effort", rows["position_rad"], "effort_stuck"),
        )
        for field, name, turned, kind in turned_by:
            stuck = [
                run
                for run in runs(rows[field], STUCK_SAMPLES)
                if np.isfinite(turned).all() and np.ptp(turned[run.start : run.end]) > TURNED_RAD
            ]
            if stuck and kind not in found:
                found.add(kind)
                yield Finding(
                    serial,
                    motion_of(event.purpose),
                    f"the time for which {name} reads exactly the same while the joint turns",
                    stuck[0].length * step_s,
                    step_s,
                    float(stuck[0].length),
                    "s",
                    "the sensor is dead or stuck",
                    kind,
                    True,
                )


def _halts(
    serial: str, judged: Sequence[JournalEvent], events: Sequence[JournalEvent], recording: Recording
) -> Iterable[Finding]:
    """Yield a joint that stood while its motion commanded it to turn, in the first motion in which it did.

    judged: motions of all joints, for inertia and held-out. events: every motion of this joint, which tell
    at which position error it turns. Constant and windowed sine motions are judged as a whole, by the
    search for the topology.
    """
    gear_ratio = recording.module_type(serial).gear_ratio if recording.modules[serial].info else np.inf
    own = [_rows_of(event, recording) for event in events if event.serial == serial]
    turning_rad = max(map(_error_while_turning, own), default=0.0)
    for event in judged:
        rows = _rows_of(event, recording)
        worst = _worst_halt(rows, gear_ratio, turning_rad) if event.serial == serial else None
        if worst is not None:
            turned_rad, wanted_rad = worst
            yield Finding(
                serial,
                motion_of(event.purpose),
                f"the range of its position within {HALTED_S:g} s",
                turned_rad,
                wanted_rad,
                (wanted_rad - turned_rad) / FOLLOWED_RAD,
                "rad",
                "its motor is dead, or something held the joint",
                "joint_halted",
                True,
            )
            return


def _rows_of(event: JournalEvent, recording: Recording) -> Rows:
    """Return the rows of a motion; none if it did not end."""
    if event.motion is None or event.motion.end_row is None:
        return np.zeros(0, ROW)
    return recording.rows(event.serial, event.motion.start_row, event.motion.end_row)


def _error_while_turning(rows: Rows) -> float:
    """Return the position error [rad] that nine of ten samples of a turning joint do not exceed.

    0 if the joint hardly turned. The tenth leaves out how a joint catches up once nothing holds it any more.
    """
    step_s = _step_s(rows["t_ns"].astype(np.int64))
    span = round(TURNS_S / step_s) if step_s > 0.0 else 0
    position = rows["position_rad"].astype(float)
    if span < 2 or len(rows) <= span:
        return 0.0
    turning = np.abs(position[span:] - position[:-span]) > TURNS_RAD_S * span * step_s
    middle = slice(span // 2, len(rows) - (span - span // 2))
    error = np.abs(rows["position_command_rad"].astype(float) - position)[middle][turning]
    error = error[np.isfinite(error)]
    return float(np.quantile(error, 0.9)) if len(error) >= TURNING_SAMPLES else 0.0


def _worst_halt(rows: Rows, gear_ratio: float, turning_rad: float) -> tuple[float, float] | None:
    """Return by how much a joint turned, and was to turn [rad], in the `HALTED_S` in which it halted most.

    None if it never did. Where its motor turned, its encoder is sick, and it did not halt; where the error is
    not beyond the one at which the joint turns otherwise, turning_rad, friction held it. What has no command,
    or rows with holes, tells nothing.
    """
    t_ns = rows["t_ns"].astype(np.int64)
    step_s = _step_s(t_ns)
    samples = round(HALTED_S / step_s) if step_s > 0.0 else 0
    if samples < 4 or len(rows) < samples:
        return None
    starts = np.unique([*range(0, len(rows) - samples, samples // 2), len(rows) - samples])
    motor = np.cumsum(np.nan_to_num(rows["motor_velocity_rad_s"].astype(float))) * step_s / gear_ratio
    position, command = rows["position_rad"].astype(float), rows["position_command_rad"].astype(float)
    columns = position, command, motor, t_ns.astype(float), command - position
    windows = [sliding_window_view(column, samples)[starts] for column in columns]
    turned, wanted, by_motor, lasted_ns = (np.ptp(one, axis=1) for one in windows[:4])
    halted = (wanted >= HALTED_RAD) & (np.maximum(turned, by_motor) < MIN_FOLLOWED * wanted)
    halted &= np.abs(windows[4]).max(axis=1) > STICKING * turning_rad + FOLLOWED_RAD
    halted &= lasted_ns < 1.5 * HALTED_S * NS_PER_S
    if not halted.any():
        return None
    worst = int(np.where(halted, wanted - turned, -np.inf).argmax())
    return float(turned[worst]), float(wanted[worst])


def _jumps(serial: str, rows: Rows) -> Iterable[Finding]:
    """Yield the largest jump of an encoder between two samples, if it is slower before and after."""
    q, t_ns = rows["position_rad"], rows["t_ns"].astype(np.int64)
    if len(q) < 4:
        return
    step, gap = np.diff(q), np.diff(t_ns)
    apart = np.minimum(np.abs(step[1:-1] - step[:-2]), np.abs(step[1:-1] - step[2:]))
    # A step that is slower or faster than the one before and the one after; a hole in the rows is none.
    # By signs: the product of what a damaged row holds may be no number.
    alone = np.sign(step[1:-1] - step[:-2]) * np.sign(step[1:-1] - step[2:]) > 0.0
    whole = np.abs(gap[1:-1]) < LONG_TICKS * np.median(gap)
    size = np.where(alone & whole, apart, 0.0)
    worst = int(size.argmax())
    if size[worst] > JUMP_RAD:
        turned, usual = float(step[1 + worst]), float(np.median(np.abs(step)))
        yield Finding(
            serial,
            WHOLE,
            "a turn of its encoder between two samples",
            turned,
            usual,
            abs(turned) / JUMP_RAD,
            "rad",
            "its encoder jumped, and its positions before and after do not belong together",
            "encoder_jump",
            True,
        )


def _clocks(recording: Recording, rows: dict[str, Rows]) -> Iterable[Finding]:
    """Yield the clocks that went back, leapt, or stood, while round trips show that others did not.

    An agent that was held up leaves as large a hole between two rows, but its clock agrees with the session's
    as before. What a module measures while its clock stands is refused, and leaves no sign in its rows.
    """
    trips = {serial: module.round_trips for serial, module in recording.modules.items()}
    stood = clocks_that_stood(trips)
    for serial, own in rows.items():
        t_ns = own["t_ns"].astype(np.int64)
        gap = np.diff(t_ns)
        if not len(gap):
            continue
        usual = float(np.median(gap))
        back, leap = int(gap.argmin()), int(gap.argmax())
        others = [some for other, some in trips.items() if other != serial]
        at = None
        if gap[back] < 0:
            at = back
        elif gap[leap] > LEAP_NS + LONG_TICKS * usual and leapt(trips[serial], others, int(t_ns[leap])):
            at = leap
        if at is not None:
            yield _clock_jump(serial, "a step of its clock between two rows", float(gap[at]), usual)
        elif serial in stood:
            yield _clock_jump(serial, "a step of its clock against those of others", -stood[serial], 0.0)


def _clock_jump(serial: str, what: str, step_ns: float, usual_ns: float) -> Finding:
    return Finding(
        serial,
        WHOLE,
        what,
        step_ns / NS_PER_S,
        usual_ns / NS_PER_S,
        abs(step_ns - usual_ns) / LEAP_NS,
        "s",
        "its clock jumped, and its samples before and after do not belong together",
        "clock_jump",
        True,
    )


def _not_finite(recording: Recording, serials: Sequence[str]) -> Iterable[Finding]:
    """Yield the modules that sent values that are no numbers: such messages are excluded whole."""
    for serial in serials:
        count = recording.not_finite.get(serial, 0)
        if count:
            text, remedy = "the number of its messages with values that are no numbers", "they are excluded"
            yield Finding(
                serial, WHOLE, text, float(count), 0.0, float(count), "", remedy, "not_finite", True
            )
