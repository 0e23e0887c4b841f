"""A sensor that reads what no working module can is held over, then named; a good one is left as it is."""

import math

import pytest

from module_agent.hardware.hardware import SensorSample
from module_agent.hardware.sample_check import GOOD_PER_BAD, MAX_HELD, MAX_OWED, SampleCheck
from module_agent.model.catalogue import AMBIENT_C, CATALOGUE

KIND = CATALOGUE["X5-9"]
GOOD = SensorSample(5, 4, *(0.1 * k for k in range(1, 16)))  # type: ignore[call-arg]
FIELDS = SensorSample._fields[2:]
# The largest believable readings, by what limits each.
MOST = dict(
    zip(
        FIELDS,
        (
            *(1e4, 50.0 * 1.466, 50.0 * 13.0, 10.0, 50.0 * 1.466 * 1742.22, 200.0, 400.0, 100.0),
            *(500.0, 500.0, 500.0, 5e4, 5e4, 5e4, 50.0 * 1.466),
        ),
        strict=True,
    )
)


def test_a_good_sample_is_itself() -> None:
    check = SampleCheck(KIND)
    assert not check.is_clean
    assert check.fault == ""
    assert check.checked(GOOD) is GOOD
    assert (check.is_clean, check.fault) == (True, "")


@pytest.mark.parametrize("name", FIELDS)
def test_the_largest_reading_is_good_and_the_next_one_is_not(name: str) -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD)
    for sign in (1.0, -1.0):
        most = sign * MOST[name]
        at_limit = GOOD._replace(**{name: most})
        assert check.checked(at_limit) is at_limit
        beyond = GOOD._replace(**{name: math.nextafter(most, sign * math.inf)})
        assert check.checked(beyond) == at_limit
        assert not check.is_clean
        check.checked(GOOD)


@pytest.mark.parametrize("name", FIELDS)
def test_one_bad_value_is_replaced_and_all_others_are_new(name: str) -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD)
    new = SensorSample(9, 8, *(0.2 * k for k in range(1, 16)))  # type: ignore[call-arg]
    checked = check.checked(new._replace(**{name: math.nan}))
    assert checked == new._replace(**{name: getattr(GOOD, name)})
    # What was held over goes on being so.
    assert check.checked(new._replace(**{name: math.inf})) == checked


@pytest.mark.parametrize("name", FIELDS)
def test_next_to_a_bad_value_the_largest_good_one_is_kept(name: str) -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD)
    other = FIELDS[FIELDS.index(name) - 1]
    assert getattr(check.checked(GOOD._replace(**{name: MOST[name], other: math.nan})), name) == MOST[name]


def test_the_sixth_bad_sample_in_a_row_is_a_fault_and_a_good_one_ends_it() -> None:
    check = SampleCheck(KIND)
    bad = GOOD._replace(effort_nm=math.nan, voltage_v=-101.0)
    for _ in range(2):
        check.checked(GOOD)
        for _ in range(MAX_HELD):
            check.checked(bad)
            assert check.fault == ""
        check.checked(bad)
        assert check.fault == "voltage_v reads -101, possible are -100 .. 100"
        check.checked(GOOD)
        assert check.fault == ""
    assert MAX_HELD == 5


@pytest.mark.parametrize("good", [1, 3, 6])
def test_a_sensor_that_is_bad_time_and_again_is_a_fault_until_it_is_good_for_a_while(good: int) -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD)
    bad, said = GOOD._replace(effort_nm=math.nan), []
    for _ in range(1000):
        check.checked(bad)
        for _ in range(good):
            check.checked(GOOD)
            said.append(check.fault)
    first = said.index(f"effort_nm reads nan, possible are -{MOST['effort_nm']:g} .. {MOST['effort_nm']:g}")
    assert 1 + first // good >= MAX_OWED // GOOD_PER_BAD
    # From then on it is not well for a moment.
    assert "" not in said[first:]
    for _ in range(MAX_OWED - good):
        assert check.fault
        check.checked(GOOD)
    assert check.fault == ""
    assert (GOOD_PER_BAD, MAX_OWED) == (8, 200)


def test_a_bad_sample_is_made_up_for_by_eight_good_ones_also_before_the_first_good_one() -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD._replace(effort_nm=math.nan))
    for _ in range(GOOD_PER_BAD):
        assert not check.is_clean
        check.checked(GOOD)
    assert check.is_clean


def test_only_more_than_is_made_up_for_in_a_while_is_a_loose_contact() -> None:
    bad = GOOD._replace(effort_nm=math.nan)
    for many, is_loose in ((MAX_OWED // GOOD_PER_BAD, False), (MAX_OWED // GOOD_PER_BAD + 1, True)):
        check = SampleCheck(KIND)
        for _ in range(many):
            check.checked(bad)
        assert check.fault
        check.checked(GOOD)
        assert bool(check.fault) is is_loose
    # In the end exactly `MAX_OWED` good ones are owed, and never more than five samples were bad in a row.
    check = SampleCheck(KIND)
    check.checked(GOOD)
    for good in (2, 2, 2, 1, 1):
        for _ in range(MAX_HELD):
            check.checked(bad)
        for _ in range(good):
            check.checked(GOOD)
    check.checked(bad)
    assert check.fault == ""


def test_a_bad_sample_now_and_then_is_none() -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD)
    bad = GOOD._replace(effort_nm=math.nan)
    for _ in range(1000):
        check.checked(bad)
        assert check.fault == ""
        for _ in range(GOOD_PER_BAD):
            assert not check.is_clean
            check.checked(GOOD)
        assert check.is_clean


def test_before_a_good_sample_a_bad_one_is_a_fault_at_once_and_reads_as_at_rest() -> None:
    check = SampleCheck(KIND)
    first = check.checked(SensorSample(3, 2, *(math.nan,) * 15))  # type: ignore[call-arg]
    assert first == SensorSample(3, 2, *(0.0,) * 6, AMBIENT_C, *(0.0,) * 8)  # type: ignore[call-arg]
    assert "deflection_velocity_rad_s reads nan" in check.fault


IMU = ("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s", "accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2")


@pytest.mark.parametrize("imu_t_ns", [3, 10])
def test_readings_of_an_imu_time_that_cannot_be_are_held_over_with_their_time_and_then_named(
    imu_t_ns: int,
) -> None:
    """Earlier than the last one, or later than the module's own time."""
    check = SampleCheck(KIND)
    check.checked(GOOD)
    bad = SensorSample(9, imu_t_ns, *(0.2 * k for k in range(1, 16)))  # type: ignore[call-arg]
    held = bad._replace(imu_t_ns=4, **{name: getattr(GOOD, name) for name in IMU})
    for _ in range(MAX_HELD):
        assert check.checked(bad) == held
        assert (check.fault, check.is_clean) == ("", False)
        bad = bad._replace(t_ns=bad.t_ns + 1, imu_t_ns=bad.imu_t_ns + (imu_t_ns == 10))
        held = held._replace(t_ns=bad.t_ns)
    check.checked(bad)
    assert check.fault == f"imu_t_ns reads {bad.imu_t_ns}, possible are 4 .. {bad.t_ns}"
    good = bad._replace(imu_t_ns=4)
    assert check.checked(good) is good
    assert check.fault == ""


@pytest.mark.parametrize("imu_t_ns", [4, 9])
def test_the_last_time_of_the_imu_and_that_of_the_sample_are_possible(imu_t_ns: int) -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD)
    sample = GOOD._replace(t_ns=9, imu_t_ns=imu_t_ns)
    assert check.checked(sample) is sample


@pytest.mark.parametrize("imu_t_ns", [4, 9])
def test_an_imu_that_was_read_at_a_possible_time_counts_next_to_a_bad_reading(imu_t_ns: int) -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD)
    sample = GOOD._replace(t_ns=9, imu_t_ns=imu_t_ns, gyro_x_rad_s=0.5, position_rad=math.nan)
    assert check.checked(sample) == sample._replace(position_rad=GOOD.position_rad)


@pytest.mark.parametrize("t_ns", [5, 2])
def test_a_clock_that_goes_back_takes_the_time_of_the_imu_along(t_ns: int) -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD)
    back = GOOD._replace(t_ns=t_ns, imu_t_ns=1)
    assert check.checked(back) is back


def test_until_the_imu_is_read_by_a_clock_that_went_back_its_old_readings_are_of_now() -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD)
    # What the IMU read last is still there, by the clock before.
    assert check.checked(GOOD._replace(t_ns=2)) == GOOD._replace(t_ns=2, imu_t_ns=2)
    assert check.checked(GOOD._replace(t_ns=3)) == GOOD._replace(t_ns=3, imu_t_ns=2)
    new = GOOD._replace(t_ns=4, imu_t_ns=4)
    assert check.checked(new) is new


def test_before_a_good_sample_the_imu_was_read_at_the_zero_of_the_clock_or_later() -> None:
    early = GOOD._replace(t_ns=1, imu_t_ns=-1)
    check = SampleCheck(KIND)
    assert check.checked(early) == early._replace(imu_t_ns=0, **dict.fromkeys(IMU, 0.0))
    assert check.fault == "imu_t_ns reads -1, possible are 0 .. 1"
    at_zero = GOOD._replace(t_ns=1, imu_t_ns=0)
    assert SampleCheck(KIND).checked(at_zero) is at_zero


def test_among_readings_that_are_held_over_one_that_was_bad_is_not_named() -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD)
    bad = GOOD._replace(t_ns=9, imu_t_ns=10, accel_x_m_s2=math.nan)
    for _ in range(MAX_HELD + 1):
        assert check.checked(bad) == GOOD._replace(t_ns=9)
    assert "imu_t_ns reads 10" in check.fault


def test_a_quiet_tick_gives_the_values_that_are_held_over_next() -> None:
    check = SampleCheck(KIND)
    check.checked(GOOD)
    check.go_on(GOOD._replace(position_rad=7.0))
    assert check.checked(GOOD._replace(position_rad=math.nan)).position_rad == 7.0
