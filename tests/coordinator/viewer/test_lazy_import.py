"""Rerun takes 0.4 s and 100 MB to import, so it is imported by the first viewer that has a target."""

import subprocess
import sys

import pytest

HEAVY = ("rerun", "rerun_bindings", "pyarrow", "matplotlib")


@pytest.mark.parametrize(
    "code",
    [
        "import coordinator.session.run, sim.virtual_time.run, sim.commands.run, coordinator.commands.run",
        "from coordinator.viewer.viewer import *; Viewer('arm', 'r', ViewerTargets()).phase(0, 'nothing')",
    ],
    ids=["a run's modules", "a viewer without a target"],
)
def test_rerun_is_not_imported_without_a_target(code: str) -> None:
    check = f"import sys; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{check}"], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
