"""Ends a session of benchmarks with a table of all figures and bars, also written as `runs/bench.json`."""

import os
import platform
from math import isfinite
from pathlib import Path

import pytest

from module_agent.model.files import write_json
from tests.benchmarks.bars import FIGURES, Figure, line

RESULTS = Path("runs") / "bench.json"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if not FIGURES:
        return
    terminalreporter.section("figures")
    for figure in FIGURES:
        terminalreporter.line(line(figure), red=figure.met is False, green=figure.met is True)
    held = [figure for figure in FIGURES if figure.met is not None]
    path = config.rootpath / RESULTS
    write_figures(path, FIGURES)
    terminalreporter.line(
        f"{sum(figure.met is True for figure in held)} of {len(held)} bars met "
        f"(load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores); {path}"
    )


def write_figures(path: Path, figures: list[Figure]) -> None:
    """Write figures as JSON with the machine that they were measured on; null for what is not finite."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [
        {
            **figure._asdict(),
            "value": figure.value if isfinite(figure.value) else None,
            "met": figure.met,
        }
        for figure in figures
    ]
    machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
    write_json(path, {"schema": 1, "machine": machine, "figures": rows})
