"""A bar is met or missed by what was measured, and chance is allowed for where there are few trials."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from sim.benchmark.row import (
    COVERAGE,
    FEW_INTERVALS,
    Row,
    count,
    coverage,
    largest,
    mean_abs,
    ratio,
    rms,
    widened,
)


@pytest.mark.parametrize(
    ("ours", "limit", "holds"),
    [
        (0.5, 0.5, True),
        (0.51, 0.5, False),
        (0.0, 0.0, True),
        (None, 0.5, False),
        (math.nan, 0.5, False),
        (95.0, (92.0, 98.0), True),
        (99.0, (92.0, 98.0), False),
        (91.9, (92.0, 98.0), False),
        (1e9, None, None),
        (None, None, None),
    ],
)
def test_a_bar_is_met_up_to_its_limit_and_missed_without_a_figure(
    ours: float | None, limit: float | tuple[float, float] | None, holds: bool | None
) -> None:
    assert Row("error [mm]", ours, limit).holds is holds


def test_a_row_in_json_has_the_agreed_fields_and_no_number_that_json_lacks() -> None:
    found = Row("error [mm]", math.nan, 0.5, math.inf, 0.1, "arm").plain()
    assert list(found) == [
        *("case", "profile", "known", "figure", "thesis", "ours", "bound", "limit", "holds")
    ]
    assert (found["thesis"], found["ours"], found["bound"], found["holds"]) == (None, None, 0.1, False)


def test_the_bar_of_few_errors_is_as_wide_as_chance_makes_it() -> None:
    drawn = np.random.default_rng(0).normal(size=(20_000, 3))
    beyond = np.sqrt(np.mean(drawn**2, axis=1)) > widened(1.5, 3)
    # One of 100, as 20 000 draws tell it to 7 %.
    assert np.mean(beyond) == pytest.approx(0.01, rel=0.3)
    assert widened(1.5, 3) > widened(1.5, 6) > widened(1.5, 39) == 1.5
    assert widened(1.5, 0) == 1.5


def test_what_is_not_there_is_left_out_of_means() -> None:
    assert mean_abs([-3.0, None, 1.0]) == 2.0
    assert rms([3.0, None, -4.0]) == pytest.approx(math.sqrt(12.5))
    assert largest([-3.0, 2.0, None]) == 3.0
    for figure in (mean_abs, rms, largest):
        assert figure([None]) is None
        assert figure([]) is None
    assert ratio(1.0, None) is None
    assert ratio(1.0, 0.0) is None
    assert ratio(3.0, 2.0) == 1.5


@pytest.mark.parametrize("figure", [mean_abs, rms, largest])
@pytest.mark.parametrize("values", [[math.nan, 1.0], [1.0, math.nan]])
def test_one_value_that_is_no_number_makes_the_figure_none_and_the_bar_missed(
    figure: Callable[[list[float | None]], float | None], values: list[float | None]
) -> None:
    found = figure(values)
    assert found is not None
    assert math.isnan(found)
    assert Row("error [mm]", found, 5.0).holds is False


def test_what_must_never_be_is_counted_and_of_no_cases_nothing_is_known() -> None:
    found = count("wrong", [False, True, True])
    assert (found.figure, found.ours, found.holds) == ("wrong, of 3", 2.0, False)
    assert count("wrong", [False]).holds
    assert count("wrong", []).holds is False


def test_honest_intervals_of_any_number_meet_the_bar_of_coverage_and_shy_or_bold_ones_do_not() -> None:
    rng = np.random.default_rng(5)
    for number in (10, 60, FEW_INTERVALS, 1000):
        rows = [coverage(list(np.abs(rng.standard_normal(number)))) for _ in range(200)]
        # Chance leaves the range in one of a hundred where it is widened; at 200 by two sigmas, in one of 20.
        assert np.mean([row.holds for row in rows]) > (0.97 if number != FEW_INTERVALS else 0.90)
    many = np.abs(rng.standard_normal(1000))
    assert not coverage(list(2.0 * many)).holds
    assert not coverage(list(0.3 * many)).holds
    assert coverage(list(many)).limit == COVERAGE


def test_coverage_without_intervals_misses_its_bar() -> None:
    assert coverage([]).holds is False
