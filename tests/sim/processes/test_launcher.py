"""How many processes a launch has, and which modules each of them hosts."""

from pathlib import Path

import pytest

from module_agent.control.safety import Safety
from module_agent.control.safety_file import read_safety
from sim.processes.launcher import SAFETY, LaunchConfig, Launcher, default_processes


@pytest.mark.parametrize(
    ("modules", "cores", "processes"),
    [(2, 4, 2), (4, 4, 4), (4, 2, 2), (16, 2, 2), (17, 2, 3), (64, 2, 8), (64, 16, 16)],
)
def test_processes_are_one_a_core_and_more_where_each_would_host_over_eight_modules(
    modules: int, cores: int, processes: int
) -> None:
    assert default_processes(modules, cores) == processes


@pytest.mark.parametrize("processes", [1, 3, 5, None])
def test_every_module_is_in_one_process(processes: int | None) -> None:
    serials = tuple("ABCDE")
    shares = LaunchConfig("file", "robot", serials, Path(), processes=processes).shares
    assert sorted("".join("".join(share) for share in shares)) == list(serials)
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_agents_read_the_limits_of_their_modules_from_the_folder_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = {serial: Safety(position_rad=(-1.0, k)) for k, serial in enumerate("ABC", start=1)}
    config = LaunchConfig("file", "robot", ("A", "B", "C"), tmp_path, processes=2, safety=limits)
    launcher = Launcher(config, lambda line: None)
    started: list[list[str]] = []

    def start(name: str, arguments: list[str], up: str, environment: dict[str, str]) -> None:
        started.append(arguments)

    monkeypatch.setattr(launcher, "_start", start)
    launcher.start_agents()
    read = {}
    for arguments in started:
        path = Path(arguments[arguments.index("--safety") + 1])
        assert path == tmp_path / SAFETY
        serials = [arguments[k + 1] for k, word in enumerate(arguments) if word == "--serial"]
        read |= read_safety(path, serials)
    assert read == limits
