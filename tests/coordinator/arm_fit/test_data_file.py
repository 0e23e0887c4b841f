"""Recordings of other people's robots: the same motion from either format, and errors that show the place."""

from pathlib import Path

import numpy as np
import pytest
from numpy.random import Generator, default_rng

from coordinator.arm_fit.data_file import DataFileError, JointLog, in_two, read_log
from module_agent.model.chain import Array

JOINTS = ("shoulder", "elbow")
HEADER = "t_s,q_elbow_rad,q_shoulder_rad,note,tau_elbow_nm,tau_shoulder_nm"


@pytest.fixture
def rng() -> Generator:
    return default_rng(1)


def signals(rng: Generator, rows: int = 40) -> dict[str, Array]:
    return {key: rng.normal(size=(rows, 2)) for key in ("position_rad", "torque", "velocity_rad_s")}


def csv_text(found: dict[str, Array], rate_hz: float, velocity: bool = False) -> str:
    """Columns of the elbow first: the order in the file is not that of the robot."""
    lines = [HEADER + (",qd_shoulder_rad_s,qd_elbow_rad_s" if velocity else "")]
    for i in range(len(found["torque"])):
        q, tau, qd = (found[key][i] for key in ("position_rad", "torque", "velocity_rad_s"))
        cells = [i / rate_hz, q[1], q[0], "fine", tau[1], tau[0], *([qd[0], qd[1]] if velocity else [])]
        lines.append(",".join(cell if isinstance(cell, str) else repr(float(cell)) for cell in cells))
    return "\n".join(lines) + "\n"


def test_a_csv_and_an_npz_of_the_same_motion_are_read_alike(tmp_path: Path, rng: Generator) -> None:
    found = signals(rng)
    (tmp_path / "a.csv").write_text(csv_text(found, 500.0, velocity=True))
    np.savez(tmp_path / "a.npz", sample_rate_hz=500.0, **found)
    one, other = (read_log(tmp_path / name, JOINTS) for name in ("a.csv", "a.npz"))
    assert one.qd_rad_s is not None
    assert other.qd_rad_s is not None
    for ours, theirs in zip(one[1:4], other[1:4], strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(one.q_rad, found["position_rad"])
    assert one.rate_hz == pytest.approx(500.0)
    assert other.duration_s == pytest.approx(39 / 500.0)
    assert not one.resampled


def test_named_columns_of_an_npz_are_put_into_the_robots_order(tmp_path: Path, rng: Generator) -> None:
    found = signals(rng)
    t_s = np.arange(40) / 100.0
    np.savez(tmp_path / "a.npz", t_s=t_s, joint_names=np.array(JOINTS[::-1]), **found)
    log = read_log(tmp_path / "a.npz", JOINTS)
    np.testing.assert_array_equal(log.tau_nm, found["torque"][:, ::-1])
    assert log.rate_hz == pytest.approx(100.0)


def test_velocities_are_not_needed(tmp_path: Path, rng: Generator) -> None:
    (tmp_path / "a.csv").write_text(csv_text(signals(rng), 100.0))
    assert read_log(tmp_path / "a.csv", JOINTS).qd_rad_s is None


def test_a_motion_on_jittering_times_is_that_on_even_ones(tmp_path: Path, rng: Generator) -> None:
    even = np.arange(400) / 200.0
    times = even + rng.uniform(-0.3, 0.3, 400) / 200.0
    wave = np.sin(2.0 * np.pi * 1.5 * times)
    motion = np.stack([wave, 2.0 * wave], axis=1)
    np.savez(tmp_path / "a.npz", t_s=times, position_rad=motion, torque=motion)
    log = read_log(tmp_path / "a.npz", JOINTS)
    assert log.resampled
    expected = np.sin(2.0 * np.pi * 1.5 * (times[0] + np.arange(len(log.q_rad)) / log.rate_hz))
    # A cubic spline at 130 samples a period: 1e-6 inside, worse at the ends, where it is one-sided.
    np.testing.assert_allclose(log.q_rad[5:-5, 0], expected[5:-5], atol=1e-5)


def test_a_recording_is_split_at_its_holes(tmp_path: Path, rng: Generator) -> None:
    found = signals(rng, 300)
    kept = np.r_[0:100, 150:300]
    times = np.arange(300) / 200.0
    np.savez(tmp_path / "a.npz", t_s=times[kept], **{key: signal[kept] for key, signal in found.items()})
    log = read_log(tmp_path / "a.npz", JOINTS)
    assert log.rate_hz == pytest.approx(200.0)
    assert log.breaks == (100,)
    assert log.duration_s == pytest.approx(99 / 200 + 149 / 200)
    first, second = log.pieces()
    np.testing.assert_array_equal(first.q_rad, found["position_rad"][:100])
    np.testing.assert_array_equal(second.tau_nm, found["torque"][150:])
    assert [len(half.breaks) for half in in_two(log)] == [1, 1]


def test_a_short_hole_is_bridged_without_swinging_out(tmp_path: Path, rng: Generator) -> None:
    t = np.arange(2000) / 1000.0
    wave = np.stack([np.sin(2.0 * np.pi * 1.5 * t), np.cos(2.0 * np.pi * 1.5 * t)], axis=1)
    kept = np.r_[0:1000, 1008:2000]
    noisy = wave + 0.1 * rng.normal(size=wave.shape)
    np.savez(tmp_path / "a.npz", t_s=t[kept], position_rad=wave[kept], torque=noisy[kept])
    log = read_log(tmp_path / "a.npz", JOINTS)
    assert (log.bridged, log.breaks) == (1, ())
    np.testing.assert_allclose(log.q_rad, wave, atol=1e-6)
    # The noise on either side, and no more.
    assert np.abs(log.tau_nm - wave)[1000:1008].max() < 0.35


@pytest.mark.parametrize("inserted", [False, True])
def test_rows_that_repeat_the_one_before_are_left_out(tmp_path: Path, rng: Generator, inserted: bool) -> None:
    t = np.arange(2000) / 1000.0
    wave = np.stack([np.sin(2.0 * np.pi * 1.5 * t), np.cos(2.0 * np.pi * 1.5 * t)], axis=1)
    stale = np.flatnonzero(rng.random(1999) < 0.06) + 1
    rows = np.arange(2000)
    if inserted:
        rows = np.sort(np.concatenate([rows, stale]))
    else:
        rows[stale] = 0
        rows = np.maximum.accumulate(rows)
    np.savez(tmp_path / "a.npz", sample_rate_hz=1000.0, position_rad=wave[rows], torque=wave[rows])
    log = read_log(tmp_path / "a.npz", JOINTS)
    assert log.repeated == pytest.approx(len(stale), abs=10)
    assert log.resampled is not inserted
    # A cubic spline over two intervals; a stale row alone is off by 0.01.
    np.testing.assert_allclose(log.q_rad[:1990], wave[:1990], atol=1e-6)


def test_rows_are_not_repeated_by_a_rest_or_a_coarse_encoder(tmp_path: Path) -> None:
    t = np.arange(4000) / 1000.0
    wave = np.round(np.maximum(np.sin(2.0 * np.pi * 0.25 * t), 0.0), 3)
    motion = np.stack([wave, wave], axis=1)
    np.savez(tmp_path / "a.npz", sample_rate_hz=1000.0, position_rad=motion, torque=motion)
    log = read_log(tmp_path / "a.npz", JOINTS)
    assert log.breaks == ()
    np.testing.assert_allclose(log.q_rad, motion[: len(log.q_rad)], atol=2e-3)


@pytest.mark.parametrize("count", [401, 400])
def test_every_other_sample_shows_the_same_motion_with_noise_of_its_own(rng: Generator, count: int) -> None:
    t = np.arange(count) / 400.0
    wave = np.stack([np.sin(2.0 * np.pi * 3.0 * t), np.cos(2.0 * np.pi * 3.0 * t)], axis=1)
    noise = 0.01 * rng.normal(size=wave.shape)
    clean = in_two(JointLog(400.0, wave, 2.0 * wave, wave, False))
    noisy = in_two(JointLog(400.0, wave + noise, None, wave, False))
    assert clean[0].rate_hz == 200.0
    assert len(clean[0].q_rad) == len(clean[1].q_rad) == (count - 1) // 2
    # A cubic spline at 67 samples a period: (2 pi / 67)^4 / 384 inside, some ten times that at the ends.
    np.testing.assert_allclose(clean[0].q_rad, clean[1].q_rad, atol=1e-5)
    assert clean[1].qd_rad_s is not None
    np.testing.assert_allclose(clean[1].qd_rad_s, 2.0 * clean[1].q_rad, rtol=1e-9, atol=1e-12)
    one, other = (found.q_rad - first.q_rad for found, first in zip(noisy, clean, strict=True))
    # Correlation of 400 pairs of independent numbers: 1 / sqrt(400), times four.
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.2


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("q_elbow_rad", "q_wrist_rad", r"line 1: no column q_elbow_rad; the columns are t_s, q_wrist_rad"),
        ("note", "q_elbow_rad", r"line 1: column q_elbow_rad appears twice"),
        ("note", "qd_elbow_rad_s", r"line 1: no column qd_shoulder_rad_s"),
        ("fine", "fine,7", r"line 2: 7 cells; the first line names 6 columns"),
        ("\n0.02,", "\n0.02,nan,", r"line 4: 7 cells"),
        ("\n0.02,", "\nsoon,", r"line 4, column t_s: 'soon'; a finite number is needed"),
        ("\n0.02,", "\n0.01,", r"line 4: its time 0.01 s is not after that of the sample before it"),
        ("\n0.05,", "\n\n\n0.02,", r"line 9: its time 0.02 s is not after"),
    ],
)
def test_a_csv_that_cannot_be_used_is_answered_with_the_place(
    tmp_path: Path, rng: Generator, old: str, new: str, words: str
) -> None:
    path, text = tmp_path / "a.csv", csv_text(signals(rng), 100.0)
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DataFileError, match=words) as raised:
        read_log(path, JOINTS)
    assert str(raised.value).startswith(str(path))


def npz_with(rng: Generator, **changed: object) -> dict[str, object]:
    found = {"sample_rate_hz": 100.0, **signals(rng), **changed}
    return {key: value for key, value in found.items() if value is not None}


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"position_rad": None}, r"no array position_rad; its arrays are sample_rate_hz"),
        (
            {"torque": np.zeros((40, 3))},
            r"torque has shape \(40, 3\); \(40, 2\) is needed: the joints are sh",
        ),
        ({"torque": np.full((40, 2), np.nan)}, r"torque, row 0, column 0: nan; a finite number is needed"),
        ({"torque": np.full((40, 2), "x")}, r"torque holds <U1; real numbers are needed"),
        ({"sample_rate_hz": None}, r"neither t_s nor sample_rate_hz"),
        ({"sample_rate_hz": -5.0}, r"sample_rate_hz is -5.0; one positive number is needed"),
        ({"t_s": np.zeros(40)}, r"row 1: its time 0.0 s is not after"),
        ({"t_s": np.zeros(4)}, r"t_s has shape \(4,\); 40 finite times are needed"),
        ({"joint_names": np.array(["a", "elbow"])}, r"joint_names are a, elbow; the URDF's joints are shoul"),
        ({"position_rad": np.array([[{}, 1]])}, r"not an npz file of plain arrays"),
    ],
)
def test_an_npz_that_cannot_be_used_is_answered_with_the_array(
    tmp_path: Path, rng: Generator, changed: dict[str, object], words: str
) -> None:
    np.savez(tmp_path / "a.npz", **npz_with(rng, **changed))
    with pytest.raises(DataFileError, match=words):
        read_log(tmp_path / "a.npz", JOINTS)


def test_files_of_another_kind_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mat").write_bytes(b"MATLAB")
    (tmp_path / "a.npz").write_bytes(b"no zip")
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00")
    for name, words in (
        ("a.mat", ".csv, .npz, .mcap are read"),
        ("a.npz", "npz file"),
        ("a.csv", "not a CSV file"),
    ):
        with pytest.raises(DataFileError, match=words):
            read_log(tmp_path / name, JOINTS)
