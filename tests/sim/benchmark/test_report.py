"""What a benchmark found reaches its file, its table and its picture."""

import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from coordinator.runtime.terminal import print_table
from module_agent.model.errors import UsageError
from sim.benchmark.case import Case, CaseResult, Failed, Summary, Trial, concluded, trial_seeds
from sim.benchmark.report import SCHEMA, Results, plot, write_results
from sim.benchmark.row import Row
from sim.benchmark.workers import run_cases
from sim.commands.benchmark import table

ROWS = (
    Row("length [mm]", 0.12, 0.5, 4.35, 0.08, "long arm"),
    Row("runs without the right topology, of 13", 1.0, 0.0, case="long arm"),
    Row("length [mm]", 0.9, 0.5, 17.0, 0.2, "tall post"),
    Row("robot time [s]", 8.5, case="tall post"),
    Row("95 % intervals that cover, of 300 [%]", 95.0, (92.0, 98.0), case="all cases"),
)


def total(results: Any) -> Summary:
    return Summary([Row("of all", float(sum(results)), 10.0)], tuple(map(float, results)))


def test_the_file_holds_every_row_with_its_verdict_and_what_was_asked_for(tmp_path: Path) -> None:
    cases = [
        CaseResult("long arm", 13, Summary(ROWS[:2]), ("it fell",), 30.5),
        CaseResult("tall post", 13, Summary(ROWS[2:4]), (), 20.25),
    ]
    found = Results("kinematics", {"seed": 3, "quick": True}, cases, ROWS[4:], 12.5)
    path = tmp_path / "found.json"
    path.write_text("of yesterday")
    write_results(path, found)
    document = json.loads(path.read_text())
    assert document["schema"] == SCHEMA
    assert document["settings"] == {"seed": 3, "quick": True}
    assert [row["holds"] for row in document["rows"]] == [True, False, False, None, True]
    assert document["rows"][4]["limit"] == [92.0, 98.0]
    assert document["failures"] == ["long arm: it fell"]
    assert document["costs"][0] == {"case": "long arm", "trials": 13, "cpu_time_s": 30.5}
    assert found.cpu_time_s == 50.75
    assert set(document["versions"]) >= {"python", "numpy", "numba"}
    assert [each.name for each in tmp_path.iterdir()] == ["found.json"]
    assert found.missed == [ROWS[1], ROWS[2]]


def test_the_table_says_in_words_what_its_colours_say_and_keeps_units() -> None:
    console = Console(width=160, no_color=True)
    with console.capture() as capture:
        console.print(table(ROWS, "Benchmark"))
    text = capture.get()
    assert text.count("holds") == 2
    assert text.count("MISSED") == 2
    assert "length [mm]" in text
    assert "92 to 98" in text
    assert text.count("long arm") == 1


def test_a_table_in_a_pipe_is_not_cut_short(capsys: pytest.CaptureFixture[str]) -> None:
    long = Row(
        "and a figure with a long one as well [mm]",
        1.0,
        1.0,
        1.0,
        1.0,
        "a case with quite a long name, x5-uncalibrated",
    )
    print_table(table([long], "Benchmark"))
    shown = capsys.readouterr().out
    assert long.case in shown
    assert long.figure in shown


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_rows_with_a_bar_are_drawn(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"found.{suffix}"
    plot(ROWS, path)
    assert path.stat().st_size > 5000


def test_the_picture_shows_every_case_under_its_figure(tmp_path: Path) -> None:
    path = tmp_path / "found.svg"
    plot(ROWS, path)
    # Letters are drawn as paths, each with its text as a comment.
    text = path.read_text()
    for words in ("length [mm]", "runs without the right topology", "tall post", "all cases"):
        assert f"<!-- {words} -->" in text
    assert "robot time" not in text


def test_without_a_bar_there_is_nothing_to_draw(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no row has a bar"):
        plot([ROWS[3]], tmp_path / "found.png")


def test_a_case_is_summarised_from_its_own_trials_in_their_order() -> None:
    def in_order(results: Any) -> Summary:
        assert list(results) == [4, 9]
        return total(results)

    cases = [
        Case("squares", (Trial(pow, (2, 2)), Trial(pow, (3, 2), cost_s=9.0)), in_order),
        Case("cubes", (Trial(pow, (2, 3)),), total),
    ]
    told: list[tuple[str, int]] = []
    squares, cubes = run_cases(cases, 2, lambda case, left: told.append((case.name, left)))
    assert [row._replace(case="") for row in squares.summary.rows] == total([4, 9]).rows
    assert squares.summary.sigmas_off == (4.0, 9.0)
    assert squares.cpu_s >= 0.0
    assert [row.ours for row in cubes.summary.rows] == [8.0]
    assert sorted(told) == [("cubes", 0), ("squares", 0), ("squares", 1)]
    found = Results("sums", {}, [squares, cubes], [Row("", None, case="all")], 1.0)
    assert [row.case for row in found.rows] == ["squares", "cubes", "all"]
    assert [row.holds for row in found.rows] == [False, True, None]


def test_a_trial_that_failed_misses_a_bar_of_its_own_and_the_rest_is_summarised() -> None:
    case = Case("sums", (Trial(pow, (0, -1)), Trial(pow, (2, 2))), total)
    found = concluded(case, [Failed("pow(0, -1): no"), 4])
    assert found.failures == ("pow(0, -1): no",)
    failed, summed = found.summary.rows
    assert (failed.figure, failed.ours, failed.holds) == ("trials that failed, of 2", 1.0, False)
    assert summed.ours == 4.0


def test_a_trials_seed_depends_on_its_name_and_number_alone() -> None:
    assert trial_seeds(0, "arm", 3) == trial_seeds(0, "arm", 50)[:3]
    seeds = {own for s in (0, 1) for name in ("arm", "post") for own in trial_seeds(s, name, 50)}
    assert len(seeds) == 200
