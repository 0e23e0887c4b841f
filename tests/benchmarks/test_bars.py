"""The table of figures and bars (the benchmarks themselves assert nothing)."""

import json
from pathlib import Path

import pytest

from tests.benchmarks.bars import Figure, least_cpu_of, line
from tests.benchmarks.conftest import write_figures


@pytest.mark.parametrize(
    ("value", "at_most", "at_least", "met"),
    [
        (5.0, 5.0, None, True),
        (5.1, 5.0, None, False),
        (8.0, None, 8.0, True),
        (7.9, None, 8.0, False),
        (float("nan"), 5.0, None, False),
        (float("nan"), None, 8.0, False),
        (5.0, None, None, None),
    ],
)
def test_bar_is_met_up_to_its_value(
    value: float, at_most: float | None, at_least: float | None, met: bool | None
) -> None:
    figure = Figure("speed", value, "us", at_most, at_least, "the anchor")
    assert figure.met is met
    assert ("missed" in line(figure)) is (met is False)


def test_figures_are_written_with_bar_anchor_and_outcome(tmp_path: Path) -> None:
    path = tmp_path / "new" / "bench.json"
    write_figures(
        path,
        [
            Figure("ratio", 8.5, "times", None, 8.0, "loop 10 us"),
            Figure("nothing", float("inf"), "us", 1.0, None, ""),
        ],
    )
    first, second = json.loads(path.read_text())["figures"]
    assert (first["value"], first["at_least"], first["anchor"], first["met"]) == (
        8.5,
        8.0,
        "loop 10 us",
        True,
    )
    assert (second["value"], second["met"]) == (None, False)


def test_work_is_measured_in_turns() -> None:
    order: list[str] = []
    seconds = least_cpu_of([lambda: order.append("a"), lambda: order.append("b")], repeats=2, calls=2)
    assert order == list("aabbaabb")
    assert len(seconds) == 2
