"""The manufacturer's library, where it is installed, reads our safety files, and we read its."""

import math
from pathlib import Path

import numpy as np
import pytest

from module_agent.control.safety import Safety
from module_agent.control.safety_file import read_safety, safety_xml

hebi = pytest.importorskip("hebi", reason="the manufacturer's library is an extra")
LIMITS = [
    Safety(position_rad=(-1.0, 2.0), at_limit="spring", velocity_rad_s=1.5, m_stop="hold"),
    Safety(position_rad=(-0.25, 0.5), effort_nm=(-1.0, 3.0), m_stop="disabled"),
    Safety(position_rad=(-3.0, 3.0), at_limit="motor_off", m_stop="motor_off"),
    Safety(position_rad=(-3.0, 3.0), at_limit="disabled", m_stop="motor_off"),
]


def test_what_is_written_has_the_same_meaning_for_the_library(tmp_path: Path) -> None:
    path = tmp_path / "limits.xml"
    path.write_text(safety_xml(LIMITS))
    read = hebi.GroupCommand(len(LIMITS))
    read.read_safety_params(str(path))
    positions = np.array([one.position_rad for one in LIMITS]).T
    np.testing.assert_allclose([read.position_limit_min, read.position_limit_max], positions, atol=1e-6)
    np.testing.assert_array_equal(read.velocity_limit_max, [1.5, math.inf, math.inf, math.inf])
    np.testing.assert_array_equal(read.effort_limit_min, [-math.inf, -1.0, -math.inf, -math.inf])
    # The same command by the library's own words.
    meant = hebi.GroupCommand(len(LIMITS))
    meant.min_position_limit_strategy = ["DampedSpring", "HoldPosition", "MotorOff", "Disabled"]
    meant.max_position_limit_strategy = ["DampedSpring", "HoldPosition", "MotorOff", "Disabled"]
    meant.mstop_strategy = ["HoldPosition", "Disabled", "MotorOff", "MotorOff"]
    for name in ("min_position_limit_strategy", "max_position_limit_strategy", "mstop_strategy"):
        np.testing.assert_array_equal(getattr(read, name), getattr(meant, name))


def test_what_the_library_writes_is_read_as_it_was(tmp_path: Path) -> None:
    ours, its = tmp_path / "ours.xml", tmp_path / "its.xml"
    ours.write_text(safety_xml(LIMITS))
    group = hebi.GroupCommand(len(LIMITS))
    group.read_safety_params(str(ours))
    group.write_safety_params(str(its))
    assert "-0.250000" in its.read_text()
    assert list(read_safety(its, "ABCD").values()) == LIMITS


def test_an_infinite_angle_which_the_library_writes_as_nan_is_no_limit(tmp_path: Path) -> None:
    ours, its = tmp_path / "ours.xml", tmp_path / "its.xml"
    ours.write_text(safety_xml([Safety(m_stop="hold"), LIMITS[1]]))
    group = hebi.GroupCommand(2)
    group.read_safety_params(str(ours))
    group.write_safety_params(str(its))
    assert "nan" in its.read_text()
    read = read_safety(its, "AB")
    assert read["A"].range_rad == (-math.inf, math.inf)
    assert read["B"].range_rad == (-0.25, 0.5)
