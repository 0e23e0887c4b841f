"""Tests that share recordings stay on one worker."""

import pytest


@pytest.mark.xdist_group("groups")
@pytest.mark.parametrize("which", ["one", "other"])
def test_workers_know_the_group_of_a_test(request: pytest.FixtureRequest, which: str) -> None:
    """`--dist loadgroup` goes by the end of a test's id, and spreads the tests of a group if it has none."""
    if not getattr(request.config.option, "loadgroup", False):
        pytest.skip("tests are not distributed by groups")
    assert request.node.nodeid.endswith(f"[{which}]@groups")
