"""Further robots, seeds and settings of what another case of the same test tells already."""

from typing import Any

import pytest


def breadth(*cases: Any) -> list[Any]:
    """Return cases of a parametrised test that `make test-all` runs, and `make test` leaves out.

    A case is a value, or a tuple of values where the test has several parameters. What no other case tells
    does not belong here: `make test` is what a merge must pass.
    """
    return [
        pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.breadth)
        for case in cases
    ]
