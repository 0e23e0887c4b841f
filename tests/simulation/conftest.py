"""Runs that several files share; the tests that use one are one group, and stay in one process."""

from pathlib import Path

import pytest

from tests.simulation.known_arm import lived


@pytest.fixture(scope="session")
def known_arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the run that the arm is known from; it is not to be written to."""
    return lived(tmp_path_factory.mktemp("arm") / "known", 0, False)
