"""Motions from CSV: what is read of them, and what is refused with the line that is wrong."""

from pathlib import Path

import numpy as np
import pytest

from coordinator.torque_control.motion_file import read_motion
from module_agent.model.errors import UsageError

SERIALS = ("A", "B", "C")


def written(path: Path, names: str, *rows: str) -> Path:
    path.write_text("\n".join([names, *rows]) + "\n")
    return path


def test_joints_are_found_by_serial_and_by_urdf_name_in_any_order(tmp_path: Path) -> None:
    rows = [f"{q},{0.1 * k},{9.0},{-q}" for k, q in enumerate((0.0, 0.0, 0.1, 0.2, 0.2))]
    file = read_motion(written(tmp_path / "m.csv", "q_joint_C_rad,t_s,tau_A_nm,q_A_rad", *rows), SERIALS)
    assert file.joints == ("C", "A")
    reference = file.reference(SERIALS, np.array([5.0, 0.7, 5.0]))
    assert reference.q_rad.shape == (401, 3)
    np.testing.assert_allclose(reference.q_rad[::100, 2], (0.0, 0.0, 0.1, 0.2, 0.2), atol=1e-12)
    np.testing.assert_allclose(reference.q_rad[:, 0], -reference.q_rad[:, 2], atol=1e-12)
    assert (reference.q_rad[:, 1] == 0.7).all()
    assert (reference.qd_rad_s[:, 1] == 0.0).all()


def test_velocity_and_acceleration_are_those_of_the_positions(tmp_path: Path) -> None:
    t_s = np.arange(251) / 250.0
    q = 0.2 * (1.0 - np.cos(2.0 * np.pi * t_s))
    rows = [f"{t},{value}" for t, value in zip(t_s, q, strict=True)]
    reference = read_motion(written(tmp_path / "m.csv", "t_s,q_A_rad", *rows), ("A",)).reference(
        ("A",), np.zeros(1)
    )
    w = 2.0 * np.pi
    np.testing.assert_allclose(reference.qd_rad_s[:, 0], 0.2 * w * np.sin(w * reference.t_s), atol=1e-4)
    # The spline's third derivative is constant at both ends: h^2 of the fourth, 0.2 w^4, is left there.
    np.testing.assert_allclose(reference.qdd_rad_s2[:, 0], 0.2 * w**2 * np.cos(w * reference.t_s), atol=6e-3)


STILL = ("0,0", "0.1,0", "0.2,0", "0.3,0")


@pytest.mark.parametrize(
    ("names", "rows", "text"),
    [
        ("t_s,q_X_rad", STILL, "joint X is not one of the robot's: A, B, C"),
        ("t_s,q_A_rad,q_joint_A_rad", ("0,0,0",), "joint A has two columns"),
        ("t,q_A_rad", STILL, "columns t, q_A_rad; needed are t_s and q_<joint>_rad"),
        ("t_s,position", STILL, "needed are t_s and q_<joint>_rad"),
        ("", (), "columns none"),
        ("t_s,q_A_rad", STILL[:3], "3 samples; a motion has at least 4"),
        ("t_s,q_A_rad", ("0,0", "0.2,0", "0.1,0", "0.3,0"), "line 4: t_s 0.1 after 0.2: times must increase"),
        ("t_s,q_A_rad", ("0,0", "0.1,0", "0.1,0", "0.3,0"), "line 4: t_s 0.1 after 0.1"),
        ("t_s,q_A_rad", ("0,0", "0.1,x", "0.2,0", "0.3,0"), "line 3: could not convert string to float"),
        ("t_s,q_A_rad", ("0,0", "0.1", "0.2,0", "0.3,0"), "line 3: list index out of range"),
        ("t_s,q_A_rad", ("0,0", "0.1,nan", "0.2,0", "0.3,0"), "line 3: a value is not finite"),
        ("t_s,q_A_rad", ("0,0", "0.1,0.1", "0.2,0", "0.3,0"), "joint A begins at 1.00 rad/s"),
        ("t_s,q_A_rad", ("0,0", "0.1,0", "0.2,0", "0.3,1"), "joint A ends at 10.00 rad/s"),
        ("t_s,q_A_rad", ("0,0", "1,0", "2,0", "900,0"), "the motion takes 900 s, at most 600 s"),
    ],
)
def test_what_is_no_motion_of_the_robot_is_refused(
    tmp_path: Path, names: str, rows: tuple[str, ...], text: str
) -> None:
    with pytest.raises(UsageError, match=r"m\.csv") as caught:
        read_motion(written(tmp_path / "m.csv", names, *rows), SERIALS)
    assert text in str(caught.value)
