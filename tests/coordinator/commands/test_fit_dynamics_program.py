"""`x5-coordinator fit-dynamics` as it is called: files in, tables and JSON out, answers to what is wrong."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from coordinator.arm_fit.report import FitReport
from coordinator.main import app

# A pendulum of two links that swing in a plane, hanging down from a wall.
URDF = """<robot name="pendulum"><link name="wall"/>
<link name="upper"><inertial><mass value="2"/><origin xyz="0 0 -0.2"/>
<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.001"/></inertial></link>
<link name="lower"><inertial><mass value="1"/><origin xyz="0 0 -0.1"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.001"/></inertial></link>
<joint name="swing" type="continuous"><parent link="wall"/><child link="upper"/><axis xyz="0 1 0"/></joint>
<joint name="knee" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.4"/>
<axis xyz="0 1 0"/></joint></robot>"""


def write_files(folder: Path, seconds: float = 12.0) -> tuple[str, ...]:
    """Swing both joints; the torques are those of the double pendulum of textbooks, with viscous friction."""
    t = np.arange(int(seconds * 200.0)) / 200.0
    rate, phase = 2.0 * np.pi * np.array([[0.5, 0.7], [1.1, 0.9]]), np.array([[0.0, 1.0], [2.0, 0.5]])
    angle = rate * t[:, None, None] + phase
    q, qd, qdd = (
        np.sum(0.4 * part, axis=1)
        for part in (np.sin(angle), rate * np.cos(angle), -(rate**2) * np.sin(angle))
    )
    tau = double_pendulum(q, qd, qdd) + 0.3 * qd + 0.01 * np.random.default_rng(8).normal(size=q.shape)
    header = "t_s,q_swing_rad,q_knee_rad,tau_swing_nm,tau_knee_nm"
    np.savetxt(
        folder / "log.csv",
        np.column_stack([t, q, tau]),
        delimiter=",",
        header=header,
        comments="",
        fmt="%.9g",
    )
    (folder / "robot.urdf").write_text(URDF)
    return ("--urdf", str(folder / "robot.urdf"), "--data", str(folder / "log.csv"))


def double_pendulum(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Masses 2 and 1 kg, centres at 0.2 and 0.1 m, a first link of 0.4 m, inertias 0.02 and 0.01 kg m^2."""
    pull = 1.0 * 0.4 * 0.1
    bend, sine = np.cos(q[:, 1]), np.sin(q[:, 1])
    low = 0.01 + 1.0 * 0.1**2
    high = 0.02 + 2.0 * 0.2**2 + 1.0 * 0.4**2
    weight = 9.81 * 1.0 * 0.1 * np.sin(q.sum(axis=1))
    knee = (low + pull * bend) * qdd[:, 0] + low * qdd[:, 1] + pull * sine * qd[:, 0] ** 2 + weight
    swing = (high + low + 2.0 * pull * bend) * qdd[:, 0] + (low + pull * bend) * qdd[:, 1]
    swing -= pull * sine * (2.0 * qd[:, 0] * qd[:, 1] + qd[:, 1] ** 2)
    swing += weight + 9.81 * (2.0 * 0.2 + 1.0 * 0.4) * np.sin(q[:, 0])
    return np.stack([swing, knee], axis=1)


def called(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["fit-dynamics", *arguments])


def test_a_double_pendulum_is_known_from_its_torques(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    done = called(*files, "--json", str(tmp_path / "fit.json"))
    assert done.exit_code == 0, done.output
    for words in (
        "Held-out torque error",
        "filtered, masked",
        "raw, all",
        "constant mean",
        "significant",
    ):
        assert words in done.output
    found = FitReport.model_validate_json((tmp_path / "fit.json").read_text())
    assert found.schema_version == 3
    # Swinging in a plane: gravity's moment of each link and the inertia of each about its joint.
    sums = {part.summary: part for part in found.fit.base_parameters}
    hanging = sums["m2 c2z"]
    assert hanging.value == pytest.approx(-0.1, abs=4.0 * hanging.sigma)
    drives = {part.name: part.value for part in found.fit.drives}
    # 2400 samples of 0.01 Nm on speeds of some 2 rad/s.
    assert drives["Fv1"] == pytest.approx(0.3, abs=0.005)
    assert drives["Fv2"] == pytest.approx(0.3, abs=0.005)
    best = next(e for e in found.held_out if (e.model, e.tried_on, e.samples) == ("fitted", "both", "all"))
    # 0.01 Nm on some 4 Nm.
    assert best.overall is not None
    assert best.overall < 0.005
    assert not list(tmp_path.glob("*.part"))


def test_the_tables_say_what_the_file_says(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    done = called(*files, "--terms", "viscous", "--robust", "--json", str(tmp_path / "fit.json"))
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "fit.json").read_text())
    assert report["fit"]["terms"] == ["viscous"]
    assert report["fit"]["robust"] is True
    assert f"rank {report['fit']['rank']} of 22 parameters" in done.output
    for part in report["fit"]["drives"]:
        assert f"{part['value']:.4g}" in done.output
    assert [gain["without"] for gain in report["gains"]] == ["viscous"]


def test_page_torques_and_matrices_are_written(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    out = [str(tmp_path / name) for name in ("fit.html", "torques.csv", "fit.npz")]
    done = called(*files, "--html", out[0], "--predictions", out[1], "--matrices", out[2])
    assert done.exit_code == 0, done.output
    page = (tmp_path / "fit.html").read_text()
    assert page.count("<svg") == 2
    for words in ("Held-out torque error", "swing", "low-pass chosen by", "log.csv</h1>"):
        assert words in page
    assert (tmp_path / "torques.csv").read_text().startswith("t_s,piece,tau_swing_nm")
    assert (tmp_path / "fit.npz").is_file()
    assert not list(tmp_path.glob("*.part"))


def test_instruments_are_used_when_asked_for(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    done = called(*files, "--instruments", "--json", str(tmp_path / "fit.json"))
    assert done.exit_code == 0, done.output
    found = FitReport.model_validate_json((tmp_path / "fit.json").read_text())
    assert found.fit.instruments
    hanging = next(part for part in found.fit.base_parameters if part.summary == "m2 c2z")
    assert hanging.value == pytest.approx(-0.1, abs=4.0 * hanging.sigma)


def test_another_recording_may_be_held_out(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    other = tmp_path / "other.csv"
    rows = (tmp_path / "log.csv").read_text().splitlines()
    other.write_text("\n".join([rows[0], *rows[1200:]]))
    done = called(*files, "--held-out", str(other), "--json", str(tmp_path / "fit.json"))
    assert done.exit_code == 0, done.output
    assert "other recording" in done.output
    found = FitReport.model_validate_json((tmp_path / "fit.json").read_text())
    assert found.held_out_data == str(other)
    elsewhere = [e for e in found.errors("fitted") if e.tried_on == "other recording"]
    assert [e.samples for e in elsewhere] == ["all", "masked"]
    assert elsewhere[0].overall is not None
    assert elsewhere[0].overall < 0.005
    other.write_text(rows[0] + "\n")
    done = called(*files, "--held-out", str(other))
    assert done.exit_code == 2
    assert "0 samples are no recording" in done.output


def test_a_payload_is_measured_against_a_baseline(tmp_path: Path) -> None:
    files, fit = write_files(tmp_path), str(tmp_path / "fit.json")
    assert called(*files, "--json", fit).exit_code == 0
    done = called(*files, "--baseline", fit, "--json", str(tmp_path / "payload.json"))
    assert done.exit_code == 0, done.output
    text = " ".join(done.output.split())
    assert "Payload since" in text
    # What swings in a plane shows nothing across it.
    assert "payload: the torques do not determine centre y, inertia xx, inertia xy" in text
    report = FitReport.model_validate_json((tmp_path / "payload.json").read_text())
    assert report.payload is not None
    assert report.payload.link == "lower"
    refused = called(*files, "--payload-body", "lower")
    assert refused.exit_code == 2
    assert "a payload needs the --baseline" in " ".join(refused.output.split())


def test_a_urdf_without_masses_is_fitted_in_sums_and_not_written(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(urdf.read_text().replace('<mass value="1"/>', '<mass value="0"/>'))
    out = tmp_path / "fitted.urdf"
    done = called(*files, "--fitted-urdf", str(out))
    assert done.exit_code == 1, done.output
    said = " ".join(done.output.split())
    assert (
        "no physically consistent bodies: the URDF gives no mass to 'lower'; only base parameters are fitted"
        in said
    )
    assert "m2 c2z" in said
    assert not out.exists()


def test_gravity_is_what_one_says(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    errors = []
    for name, options in (
        ("right", ("--gravity", "0,0,9.81")),
        ("wrong", ("--gravity", "0,9.81,0", "--unchecked")),
    ):
        path = tmp_path / f"{name}.json"
        assert called(*files, *options, "--json", str(path)).exit_code == 0
        report = FitReport.model_validate_json(path.read_text())
        error = report.errors("fitted")[0].overall
        assert error is not None
        errors.append(error)
    # Without a pull down the pendulum's greatest torque has no column.
    assert errors[1] > 20.0 * errors[0]
    refused = called(*files, "--gravity", "0,9.81,0")
    assert refused.exit_code == 2
    assert "the base is mounted otherwise" in " ".join(refused.output.split())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--terms", "stiction"), "--terms 'stiction': known are inertia, viscous, coulomb, offset, load,"),
        (("--tried", "stribek"), "--tried 'stribek': known are inertia, viscous, coulomb, offset, load,"),
        (("--html", "/tmp"), "/tmp: is a folder; name the file to write"),
        (("--cutoff", "0"), "cutoff_hz 0.0 is outside 0 to 100.0"),
        (("--coupled", "1"), "coupled '1': it must be two different joints"),
        (("--coupled", "swing,hip"), "coupled: no joint 'hip'; the joints are 1 to 2: swing, knee"),
        (("--coupled", "2,2"), "coupled '2,2': it must be two different joints"),
        (("--gravity", "down"), "gravity 'down': it must be three numbers"),
        (("--gravity", "0,0,nan"), "gravity '0,0,nan': it must be three numbers"),
        (("--cutoff", "500"), "cutoff_hz 500.0 is outside 0 to 100.0"),
        (("--gain", "swing"), "gain 'swing': it must be a joint and its Nm per A, like elbow=8.5"),
        (("--gain", "swing=2"), "no column i_swing_a; the columns are t_s"),
        (("--trust", "0"), "trust 0.0: it must be a number above 0"),
        (("--mask", "2"), "the mask part of the top speed is 2.0; it must be between 0 and 1"),
        (("--data", "nowhere.csv"), "nowhere.csv: No such file or directory"),
        (("--urdf", "nowhere.urdf"), "nowhere.urdf: No such file or directory"),
        (("--json", "/nowhere/fit.json"), "/nowhere/fit.json: there is no folder /nowhere"),
    ],
)
def test_wrong_options_and_files_are_answered_with_what_is_right(
    tmp_path: Path, options: tuple[str, ...], words: str
) -> None:
    done = called(*write_files(tmp_path), *options)
    assert done.exit_code == 2, done.output
    assert words in " ".join(done.output.split())


def test_a_file_that_is_broken_is_named_with_the_line(tmp_path: Path) -> None:
    files = write_files(tmp_path)
    log = tmp_path / "log.csv"
    log.write_text(log.read_text().replace("\n0.05,", "\n0.05,x", 1))
    done = called(*files)
    assert done.exit_code == 2
    assert "line 12, column q_swing_rad: 'x" in done.output


def test_a_recording_too_short_for_its_parameters_is_a_failure(tmp_path: Path) -> None:
    done = called(*write_files(tmp_path, seconds=1.1), "--cutoff", "6", "--unchecked")
    assert done.exit_code == 1, done.output
    assert "nothing is left to estimate the noise from" in done.output
