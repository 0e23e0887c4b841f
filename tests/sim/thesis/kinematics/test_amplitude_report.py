"""The amplitude experiment's files, table and picture, and its command."""

import csv
import json
from pathlib import Path

import pytest
from matplotlib.image import imread
from typer.testing import CliRunner

from module_agent.model.errors import UsageError
from sim.commands.amplitudes import table
from sim.main import app
from sim.thesis.kinematics.amplitude_report import plot, repeats, write_results
from sim.thesis.kinematics.amplitude_sweep import AmplitudeTrial, Purpose
from sim.thesis.published import Alignment, thesis_length


def trial(
    number: int = 0,
    estimated_mm: float | None = 172.0,
    purpose: Purpose = "repeats",
    alignment: Alignment = "vertical",
    amplitude_rad: float = 0.04,
) -> AmplitudeTrial:
    unfiltered = None if estimated_mm is None else estimated_mm - 10.0
    return AmplitudeTrial(
        purpose, alignment, 171, 0, number, amplitude_rad, 171.0, estimated_mm, 1.0, unfiltered, 0.5, 0.5,
        amplitude_rad > 0.12, 1.0, "" if estimated_mm else "too little",
    )  # fmt: skip


def test_repeated_trials_are_summarised_by_mean_error_and_scatter() -> None:
    trials = [trial(k, value) for k, value in enumerate((172.0, 174.0, None, 176.0))]
    (row,) = repeats([*trials, trial(purpose="sweep", estimated_mm=500.0)])
    assert (row.trials, row.mean_mm, row.error_mm, row.scatter_mm) == (3, 174.0, 3.0, 2.0)
    assert row.thesis == thesis_length("vertical", 171)
    assert repeats(trials, filtered=False)[0].mean_mm == 164.0


def test_an_arm_without_estimate_is_left_out_and_one_trial_has_no_scatter() -> None:
    assert repeats([trial(estimated_mm=None)]) == []
    assert repeats([trial()])[0].scatter_mm == 0.0
    assert table(repeats([trial()])).row_count == 1


def test_files_hold_every_trial_and_both_summaries(tmp_path: Path) -> None:
    trials = [trial(0), trial(1, None), trial(purpose="sweep")]
    write_results(tmp_path / "new", {"seed": 3}, trials)
    document = json.loads((tmp_path / "new" / "amplitudes.json").read_text())
    assert document["seed"] == 3
    assert [AmplitudeTrial(**row) for row in document["trials"]] == trials
    assert document["repeats"][0]["error_mm"] == 1.0
    assert document["repeats"][0]["thesis_mean_mm"] == 188.0
    assert document["repeats_unfiltered"][0]["error_mm"] == -9.0
    with (tmp_path / "new" / "amplitudes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["estimated_mm"] for row in rows] == ["172.0", "", "172.0"]
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["amplitudes.csv", "amplitudes.json"]


def test_the_picture_has_a_panel_for_every_arm_and_shows_what_is_out_of_range(tmp_path: Path) -> None:
    sweep = [
        trial(0, estimate, "sweep", alignment, amplitude)
        for alignment in ("horizontal", "vertical")
        for amplitude, estimate in ((0.02, None), (0.1, 172.0), (0.14, 300.0))
    ]
    plot(sweep, tmp_path / "a.png", "title")
    picture = imread(tmp_path / "a.png")
    assert min(picture.shape[:2]) >= 900
    # The out-of-range estimate and the in-range one are drawn in the same colour: 0x1f5fa8.
    blue = abs(picture[..., :3] - [0x1F / 255, 0x5F / 255, 0xA8 / 255]).max(axis=2) < 0.01
    assert blue.sum() > 500
    with pytest.raises(UsageError, match="nothing to draw"):
        plot([trial()], tmp_path / "b.png", "title")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--lengths", "484,200"), "--lengths 484,200: 200 must be one of 484, 350, 245, 171"),
        (("--lengths", "long"), "'long' is no number"),
        (("--amplitudes", "0.1,nan"), "nan must be more than 0 and at most 0.5 rad"),
        (("--noise", "loud"), "unknown noise profile 'loud'; known are ideal"),
        (("--with", "wind"), "unknown effect 'wind'; known are friction"),
        (("--rigs", "0"), "greater than or equal to 1"),
    ],
)
def test_wrong_usage_is_answered_with_what_is_right(
    tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    done = CliRunner().invoke(app, ["amplitudes", "--out", str(tmp_path / "out"), *arguments])
    assert done.exit_code == 2, done.output
    assert words in done.output
    assert not (tmp_path / "out").exists()
