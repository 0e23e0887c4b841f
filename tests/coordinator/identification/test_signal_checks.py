"""Sick columns are found in the samples alone; exact sensors, joints at rest and late agents are not sick."""

import numpy as np
import pytest

from coordinator.identification.signal_checks import (
    _clipped,
    _error_while_turning,
    _inertial,
    _jumps,
    _worst_halt,
    chance_repeats,
    runs,
    sample_noise,
)
from module_agent.model.chain import Array
from module_agent.wire.feedback_rows import ROW, Rows

TICK_NS, STEP = 4_000_000, 1.06e-3


def rows(count: int = 2000, noise: float = 6e-4, seed: int = 1, bias: float = 0.0) -> Rows:
    """A module at 250 Hz that lies still for a second and then swings; the gyro has steps as real ones do."""
    draw, made = np.random.default_rng(seed), np.zeros(count, ROW)
    made["t_ns"] = made["imu_t_ns"] = TICK_NS * np.arange(count)
    swing = np.clip(np.arange(count) - 250, 0, None) * 4e-3
    made["position_rad"] = np.round(0.3 * np.sin(2.0 * swing) / 1e-4) * 1e-4
    gyro = 0.6 * np.cos(2.0 * swing)[:, None] * [0.0, 0.2, 1.0] * (swing > 0.0)[:, None]
    gyro = gyro + bias * np.random.default_rng((seed, 1)).uniform(size=3)
    made["gyro_rad_s"] = np.round((gyro + noise * draw.standard_normal((count, 3))) / STEP) * STEP
    made["accel_m_s2"] = [0.0, 0.0, 9.8] + 20.0 * noise * draw.standard_normal((count, 3))
    return made


def kinds(found: dict[str, Rows]) -> list[tuple[str, str, bool]]:
    rests = {serial: one[:250] for serial, one in found.items()}
    return [(one.serial, one.kind, one.serious) for one in _inertial(found, rests)]


def test_healthy_imus_with_steps_as_coarse_as_their_noise_are_not_stuck() -> None:
    assert kinds({f"M-{seed}": rows(20_000, seed=seed) for seed in range(4)}) == []


@pytest.mark.parametrize("digits", [0.25, 0.3, 0.4])
def test_an_imu_whose_digits_are_coarser_than_its_noise_is_stuck_only_beyond_chance(digits: float) -> None:
    """An axis that rests midway between two digits reads the same for hundreds of samples."""
    slow = {f"M-{seed}": rows(20_000, digits * STEP, seed, STEP) for seed in range(4)}
    for one in slow.values():
        one["gyro_rad_s"][:, 0] = np.round(digits * np.random.default_rng(5).standard_normal(20_000)) * STEP
    assert max(run.length for one in slow.values() for run in runs(one["gyro_rad_s"][:, 0])) > 30
    assert kinds(slow) == []
    slow["M-1"]["gyro_rad_s"][9000:, 2] = 0.0
    assert kinds(slow) == [("M-1", "gyro_stuck", True)]


def test_chance_makes_as_many_readings_alike_as_it_is_said_to() -> None:
    """With noise of a third of a digit, midway between two digits; ten times as often as one in `ONE_IN`."""
    noise = np.random.default_rng(3).standard_normal((2_000_000, 3)) / 3.0
    places = np.random.default_rng(4).uniform(size=(40, 3))
    rests = [np.round(noise[50_000 * k : 50_000 * (k + 1)] + place) for k, place in enumerate(places)]
    least = chance_repeats(rests)
    longest = max(run.length for axis in np.round(noise).T for run in runs(axis))
    # A run of a length comes once in alike^-length: of 6e6 samples it has ln(6e6) / ln(1e7) of that length.
    assert 0.7 * least < longest < least * 1.1


@pytest.mark.parametrize(("field", "kind"), [("gyro_rad_s", "gyro"), ("accel_m_s2", "accelerometer")])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("since", [0, 900])
def test_one_dead_or_stuck_axis_is_named(field: str, kind: str, axis: int, since: int) -> None:
    sick = rows()
    sick[field][since:, axis] = sick[field][since, axis]
    assert kinds({"A": rows(seed=2), "B": sick}) == [("B", f"{kind}_stuck", True)]


def test_exact_sensors_that_lie_still_are_not_stuck() -> None:
    # A simulated robot without noise: a base that is truly still, and one module that swings.
    still = rows(noise=0.0)
    still["gyro_rad_s"] = 0.0
    assert kinds({"base": still, "B": rows(noise=0.0)}) == []


def test_a_reading_that_stays_at_the_end_of_its_range_is_saturated() -> None:
    sick = rows()
    sick["gyro_rad_s"] = np.clip(sick["gyro_rad_s"], -0.4, 0.4)
    assert kinds({"A": rows(seed=2), "B": sick}) == [("B", "gyro_saturated", True)]
    # The top of a swing is no end: few samples in a row are alike there.
    assert _clipped(rows()["gyro_rad_s"][:, 2].astype(float), 6e-4) is None


@pytest.mark.parametrize("seed", range(20))
def test_the_top_of_a_slow_swing_in_coarse_steps_is_not_cut_off(seed: int) -> None:
    # Its top is in the middle of a step: a dozen samples in a row are alike there, far away from the rest.
    noise = 1e-4 * np.random.default_rng(seed).standard_normal(2000)
    swing = np.round((113 * STEP * np.sin(np.arange(2000) / 90.0) + noise) / STEP) * STEP
    assert max(run.length for run in runs(swing) if swing[run.start] == swing.max()) >= 8
    assert _clipped(swing, 6e-4) is None
    assert _clipped(np.clip(swing, -0.1, 0.1), 6e-4) is not None


def test_a_jump_of_an_encoder_is_named_and_a_hole_in_its_rows_is_not() -> None:
    jumped, with_hole = rows(), np.delete(rows(), slice(700, 800))
    jumped["position_rad"][1000:] += 0.05
    assert [one.kind for one in _jumps("A", jumped)] == ["encoder_jump"]
    assert [list(_jumps("A", one)) for one in (rows(), with_hole)] == [[], []]


@pytest.mark.filterwarnings("error")
def test_a_position_that_no_robot_has_is_a_jump() -> None:
    """A row that was damaged on its way: its square is larger than numbers are."""
    damaged = rows()
    damaged["position_rad"][1000] = 0.5 * np.finfo(damaged["position_rad"].dtype).max
    assert [one.kind for one in _jumps("A", damaged)] == ["encoder_jump"]


def test_noise_is_measured_under_motion_and_through_stretches_that_are_stuck() -> None:
    t = 4e-3 * np.arange(2000)
    signal: Array = 3.0 * np.sin(6.0 * t) + 1e-3 * np.random.default_rng(1).standard_normal(2000)
    assert sample_noise(signal) == pytest.approx(1e-3, rel=0.1)
    signal[600:] = np.where(np.arange(1400) < 700, signal[600], signal[600:])
    assert sample_noise(signal) > 3e-4


def test_runs_are_the_stretches_of_equal_values() -> None:
    found = runs(np.array([1.0, 1.0, 2.0, 3.0, 3.0, 3.0]), 2)
    assert [(one.start, one.end) for one in found] == [(0, 2), (3, 6)]
    assert found[1].length == 3


GEAR = 272.22


def followed(
    halts_s: tuple[float, float] | None = None,
    amplitude_rad: float = 0.25,
    lag_s: float = 0.05,
    for_s: float = 3.2,
) -> Rows:
    """A joint at 250 Hz that follows a swing of 1 Hz, and is held from one time to another."""
    made = np.zeros(round(250 * for_s), ROW)
    t_s = 4e-3 * np.arange(len(made))
    made["t_ns"] = TICK_NS * np.arange(len(made))
    made["position_command_rad"] = amplitude_rad * np.sin(2.0 * np.pi * t_s)
    at_s = t_s - lag_s
    if halts_s is not None:
        at_s = np.where((halts_s[0] <= t_s) & (t_s < halts_s[1]), halts_s[0] - lag_s, at_s)
    made["position_rad"] = amplitude_rad * np.sin(2.0 * np.pi * at_s)
    made["motor_velocity_rad_s"] = GEAR * np.gradient(made["position_rad"], 4e-3)
    return made


def sticking(amplitude_rad: float, error_rad: float, turns: float = 3.2) -> Rows:
    """A joint with friction and a soft loop: it stands until its position error is so large, and keeps it."""
    made = followed(amplitude_rad=amplitude_rad, for_s=turns)
    command = made["position_command_rad"].astype(float)
    position = np.zeros(len(command))
    for k in range(1, len(command)):
        position[k] = np.clip(position[k - 1], command[k] - error_rad, command[k] + error_rad)
    made["position_rad"] = position
    made["motor_velocity_rad_s"] = GEAR * np.gradient(position, 4e-3)
    return made


def worst_halt(rows: Rows, *others: Rows) -> tuple[float, float] | None:
    """Look for a halt in rows; these and other motions say at which position error the joint turns."""
    return _worst_halt(rows, GEAR, max(map(_error_while_turning, (rows, *others))))


@pytest.mark.parametrize("begin_s", [0.0, 0.26, 0.4, 1.05, 1.7, 2.4])
def test_a_joint_that_stands_for_three_quarters_of_a_second_has_halted(begin_s: float) -> None:
    found = worst_halt(followed((begin_s, begin_s + 0.8)))
    assert found is not None
    assert found[0] < 0.05
    assert found[1] > 0.2


@pytest.mark.parametrize(
    "rows",
    [
        followed(),
        # A slow loop, which is a quarter of a period late; and a motion that is hardly one.
        followed(lag_s=0.25),
        followed((0.5, 2.5), amplitude_rad=0.04),
        followed(for_s=0.3),
        followed()[:0],
    ],
    ids=["well", "late", "small", "short", "empty"],
)
def test_a_joint_that_follows_its_command_has_not_halted(rows: Rows) -> None:
    assert worst_halt(rows) is None


@pytest.mark.parametrize("error_rad", [0.05, 0.2, 0.3])
@pytest.mark.parametrize("amplitude_rad", [0.1, 0.2, 0.5])
def test_a_joint_that_friction_holds_until_its_command_is_far_enough_has_not_halted(
    amplitude_rad: float, error_rad: float
) -> None:
    rows, large = sticking(amplitude_rad, error_rad), sticking(1.0, error_rad)
    assert _error_while_turning(large) == pytest.approx(error_rad, rel=0.02)
    assert worst_halt(rows, large) is None


@pytest.mark.parametrize("error_rad", [0.05, 0.2])
def test_what_holds_a_joint_beyond_its_friction_is_a_halt(error_rad: float) -> None:
    rows = sticking(0.5, error_rad)
    # From midway between two reversals on, until the next midway but one.
    rows["position_rad"][375:562] = rows["position_rad"][375]
    rows["motor_velocity_rad_s"][375:562] = 0.0
    assert worst_halt(rows, sticking(1.0, error_rad)) is not None


def test_the_error_of_a_joint_that_hardly_turns_says_nothing() -> None:
    assert _error_while_turning(sticking(0.1, 0.3)) == 0.0
    assert _error_while_turning(followed()[:0]) == 0.0


def test_a_joint_whose_motor_turns_has_a_sick_encoder_and_did_not_halt() -> None:
    rows = followed((0.5, 2.5))
    rows["motor_velocity_rad_s"] = GEAR * np.gradient(rows["position_command_rad"], 4e-3)
    assert worst_halt(rows) is None


def test_without_a_command_or_with_a_hole_in_its_rows_a_joint_is_not_said_to_halt() -> None:
    rows = followed((0.5, 2.5))
    rows["position_command_rad"] = np.nan
    assert worst_halt(rows) is None
    # Nine rows in ten are gone while it stood.
    held = followed((0.5, 2.5))
    kept = np.r_[0:120, 130:620:10, 630:800]
    assert worst_halt(held) is not None
    assert worst_halt(held[kept]) is None
