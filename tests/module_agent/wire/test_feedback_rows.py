"""A row that is packed value by value is the record that numpy makes of the same values."""

import math
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from module_agent import decode_feedback
from module_agent.wire.codec import encode
from module_agent.wire.feedback_rows import MAX_T_NS, ROW, pack_row, unpack
from module_agent.wire.messages import Feedback
from module_agent.wire.refusal import Refusal, WireError

MEASURED = ("position_rad", "velocity_rad_s", "effort_nm", "gyro_rad_s", "accel_m_s2")

stamps = st.integers(-MAX_T_NS, MAX_T_NS)
floats = st.floats(allow_infinity=False, width=32)
values = st.tuples(stamps, stamps, st.integers(0, 2**32 - 1), st.integers(0, 255), *[floats] * 18)


def message(rows: Any) -> Feedback:
    return Feedback(serial="A", boot=1, seq=0, first_row=0, count=len(rows), rows=rows.tobytes())


@given(values, st.integers(0, 2))
def test_a_packed_row_is_the_record_that_numpy_makes(row: tuple[float, ...], slot: int) -> None:
    ring = bytearray(3 * ROW.itemsize)
    pack_row(ring, slot, row)
    expected = np.zeros(3, dtype=ROW)
    expected[slot] = (*row[:16], row[16:19], row[19:22])
    assert bytes(ring) == expected.tobytes()


def test_a_reading_too_large_for_its_field_is_kept_as_infinite_and_refused_by_readers() -> None:
    ring = bytearray(ROW.itemsize)
    pack_row(ring, 0, (1, 1, 0, 0, 0.0, -1e39, *[0.0] * 16))
    rows = np.frombuffer(ring, dtype=ROW)
    assert rows["velocity_rad_s"][0] == -math.inf
    with pytest.raises(WireError, match="velocity_rad_s of serial A is not finite"):
        unpack(message(rows))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", MEASURED)
def test_a_measurement_that_is_not_finite_is_refused_by_name_wherever_it_stands(
    field: str, bad: float
) -> None:
    for index in range(5):
        rows = np.zeros(5, dtype=ROW)
        # The last axis of a vector.
        rows[field].reshape(5, -1)[index, -1] = bad
        with pytest.raises(WireError, match=field) as refused:
            unpack(message(rows))
        assert refused.value.reason is Refusal.NOT_FINITE


def test_what_is_not_measured_may_be_unset_and_finite_giants_are_taken() -> None:
    rows = np.zeros(2, dtype=ROW)
    for field in ("position_command_rad", "velocity_command_rad_s", "effort_command_nm"):
        rows[field] = math.nan
    rows["position_rad"] = np.finfo(np.float64).max
    for field in MEASURED[1:]:
        rows[field] = np.finfo(np.float32).max
    assert unpack(message(rows)).tobytes() == rows.tobytes()


@pytest.mark.parametrize("name", ["t_ns", "imu_t_ns"])
@pytest.mark.parametrize("t_ns", [-(2**62), -(2**63), 2**63 - 1])
def test_a_time_whose_differences_have_no_room_is_refused(name: str, t_ns: int) -> None:
    rows = np.zeros(2, ROW)
    rows[name][1] = t_ns
    with pytest.raises(WireError, match="a time of serial A is beyond"):
        unpack(message(rows))


def test_a_block_of_another_length_than_announced_is_malformed() -> None:
    rows = np.zeros(2, dtype=ROW)
    odd = message(rows).model_copy(update={"rows": rows.tobytes()[:-1]})
    with pytest.raises(WireError, match="201 bytes of rows, 2 rows of 101 bytes") as refused:
        unpack(odd)
    assert refused.value.reason is Refusal.MALFORMED


def test_a_published_message_is_decoded_to_plain_numpy() -> None:
    rows = np.zeros(4, dtype=ROW)
    rows["t_ns"], rows["gyro_rad_s"] = np.arange(4), [0.1, 0.2, 0.3]
    decoded = decode_feedback(encode(message(rows).model_copy(update={"first_row": 70})))
    assert (decoded.serial, decoded.boot, decoded.first_row) == ("A", 1, 70)
    assert type(decoded.rows) is np.ndarray
    assert np.array_equal(decoded.rows, rows)
    with pytest.raises(WireError):
        decode_feedback(b"noise")


def test_importing_the_package_imports_no_numpy() -> None:
    check = "import sys, module_agent; print('numpy' in sys.modules, 'pydantic' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
