"""What `x5-coordinator compensate` refuses, and what is to be seen of it."""

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from coordinator.commands.views.compensation import (
    CompensationView,
    moment_line,
    moment_table,
    summary_fields,
    summary_table,
)
from coordinator.main import app
from coordinator.torque_control.gravity_compensation import Reading
from coordinator.torque_control.session import Moment
from coordinator.torque_control.summary import CompensationTally

SERIALS = ("A", "B")


def moment(t_s: float = 1.0, q: tuple[float, float] = (0.5, -1.0)) -> Moment:
    reading = Reading(np.array([0.012, 0.02]), np.array(q), np.array([0.1, 0.0]), np.array([1.25, -0.5]))
    return Moment("compensating", t_s, 3, reading, np.array([1.2, -0.4]))


# --------------------------------------------------------------------------- wrong usage


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--rate", "5"), "--rate 5.0: it must be 20 to 1000 Hz"),
        (("--rate", "nan"), "--rate nan: it must be 20 to 1000 Hz"),
        (("--max-speed", "0"), "--max-speed 0.0: it must be a positive number"),
        (("--damping", "-1"), "--damping -1.0: it must be 0 to 1.2 Nm s/rad, the most for type X5-4"),
        (("--damping", "nan"), "--damping nan: it must be 0 to 1.2 Nm s/rad"),
        (("--damping", "1e6"), "--damping 1000000.0: it must be 0 to 1.2 Nm s/rad"),
        (("--for", "-1"), "--for -1.0: it must be 0 to 86400 s"),
        (("--for", "nan"), "--for nan: it must be 0 to 86400 s"),
        (("--hold", "inf"), "--hold inf: it must be 0 to 600 s"),
        (("--robot", "a/b"), "robot 'a/b' cannot be part of a key"),
        (("--network", "pigeons"), "known are none, lan, lossy, wifi, bad"),
        (("--listen", "nonsense"), "endpoint 'nonsense': it must look like tcp/"),
    ],
)
def test_wrong_usage_is_answered_with_what_is_right(
    known_folder: Callable[..., Path], options: tuple[str, str], words: str
) -> None:
    done = CliRunner().invoke(app, ["compensate", str(known_folder("a2085_03")), *options])
    assert done.exit_code == 2, done.output
    assert words in done.output


def test_a_folder_that_does_not_tell_the_weight_for_certain_is_wrong_usage(
    tmp_path: Path, known_folder: Callable[..., Path]
) -> None:
    for folder, words in (
        (tmp_path / "nowhere", "holds no result.json: give the folder of a run that has finished"),
        (known_folder("a2085_03", dynamics=None), "the run had --no-dynamics"),
        (known_folder("tree_y", suspicions=["its IMU is sick"]), "its IMU is sick. Identify the robot again"),
        (
            known_folder("thesis_171_horizontal", dynamics=None, suspicions=["a module is missing"]),
            "has no inertial parameters: a module is missing; identify the robot again",
        ),
    ):
        done = CliRunner().invoke(app, ["compensate", str(folder)])
        assert done.exit_code == 2, done.output
        assert words in done.output
    # The model is taken now, and what is wrong next is the rate.
    suspect = ["compensate", str(tmp_path / "known-tree_y"), "--suspect", "--rate", "5"]
    assert "--rate 5.0: it must be" in CliRunner().invoke(app, suspect).output


# --------------------------------------------------------------------------- what is to be seen


def test_a_moment_is_a_line_in_a_pipe_and_a_row_a_joint_in_a_terminal() -> None:
    assert moment_line(SERIALS, moment()) == "compensating 1.0 s: A 28.6 deg 1.20 Nm, B -57.3 deg -0.40 Nm"
    shown = Console(file=io.StringIO(), width=120)
    shown.print(moment_table(SERIALS, moment()))
    text = shown.file.getvalue()  # type: ignore[attr-defined]
    assert "compensating, 1.0 s, 3 set-points missed" in text
    for words in ("28.6", "5.7", "1.20", "1.25", "12", "-57.3"):
        assert words in text


def test_lines_of_json_come_twice_a_second_and_hold_si_units(capsys: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    with CompensationView(SERIALS, lambda: now[0], json_file=Path("-"), quiet=True) as view:
        for k in range(201):
            now[0] = 100.0 + 0.005 * k
            view.moment(moment(0.005 * k))
        view.note("nobody hears it")
        tally = CompensationTally(SERIALS)
        view.summary(tally.summary("the time is over", False))
    *lines, summary = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["compensated_s"] for line in lines] == [0.0, 0.5, 1.0]
    assert lines[0]["joints"][1] == {
        "serial": "B",
        "position_rad": -1.0,
        "velocity_rad_s": 0.0,
        "commanded_nm": -0.4,
        "measured_nm": -0.5,
        "age_s": 0.02,
    }
    assert (summary["why"], summary["joints"]) == ("the time is over", [])


def test_a_summary_tells_how_far_how_fast_and_under_what_load_every_joint_went() -> None:
    tally = CompensationTally(SERIALS)
    way = np.linspace(0.0, 0.4, 101)
    for k, q in enumerate(way):
        # There and half the way back.
        here = q if k <= 80 else way[80] - (q - way[80]) * 2.0
        tally.add(0.01 * k, np.array([here, 0.1]), np.array([-0.4, 0.0]), np.array([3.0 if k else -5.0, 2.0]))
    tally.sent, tally.missed = 101, 2
    found = tally.summary("asked to end", False)
    assert (found.compensated_s, found.sent, found.missed) == (pytest.approx(1.0), 101, 2)
    first, second = found.joints
    assert (first.start_rad, first.end_rad) == (0.0, pytest.approx(0.16))
    assert first.farthest_rad == pytest.approx(0.32)
    assert (first.top_speed_rad_s, first.effort_max_nm) == (0.4, 5.0)
    assert first.effort_rms_nm == pytest.approx(np.sqrt((100 * 9.0 + 25.0) / 101))
    assert (second.farthest_rad, second.effort_rms_nm) == (0.0, pytest.approx(2.0))
    assert json.loads(json.dumps(summary_fields(found)))["joints"][0]["serial"] == "A"
    shown = Console(file=io.StringIO(), width=120)
    shown.print(summary_table(found))
    text = shown.file.getvalue()  # type: ignore[attr-defined]
    assert "compensated for 1.0 s: asked to end; 2 set-points missed" in text
    assert "+9.2" in text


def test_a_float_that_never_began_has_no_joints_to_tell_of() -> None:
    found = CompensationTally(SERIALS).summary("it carries something", True)
    assert (found.compensated_s, found.joints, found.is_fault) == (0.0, (), True)
