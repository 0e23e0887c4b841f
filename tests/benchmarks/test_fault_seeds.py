"""What a night of faults would cost: sessions with faults, by the command that searches them."""

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from module_agent.model.errors import EXIT_FINDING
from tests.benchmarks.bars import report

pytestmark = pytest.mark.benchmark

SEEDS, NIGHT = 50, 10_000


def test_ten_thousand_seeds_of_faults(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sim.main", "faults", "--seeds", f"0..{SEEDS - 1}", "--workers", "1"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    # Violations are findings of the search, and cost their seeds' simpler sessions as well.
    assert done.returncode in (0, EXIT_FINDING), done.stderr
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    report(
        f"{NIGHT} seeds of faults, by {SEEDS}",
        cpu_s / SEEDS * NIGHT / 3600.0,
        "core hours",
        at_most=3.0,
        anchor=f"{cpu_s / SEEDS:.2f} s a seed; {done.stdout.strip().splitlines()[-1]}",
    )
