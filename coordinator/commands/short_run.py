"""A short run of a known robot: what `check` and `payload` have in common."""

from collections.abc import Sequence
from pathlib import Path

from coordinator.baseline.known_robot import BaselineError, BaselineRobot, load_baseline
from coordinator.commands.attended_run import Place, run_attended, sender_name
from coordinator.commands.options import fail
from coordinator.excitation.plan import Plan
from coordinator.runtime.event_loop import check_speed
from coordinator.runtime.exit_codes import EXIT_USAGE
from coordinator.runtime.terminal import Terminal
from coordinator.session.run import RunConfig
from module_agent.network_emulation.profile_file import network as network_named
from module_agent.wire.keys import check_chunk


def baseline_or_fail(folder: Path) -> BaselineRobot:
    """Return the robot that a run tells of, or end the command."""
    try:
        return load_baseline(folder)
    except BaselineError as error:
        fail(error, EXIT_USAGE)


def run_again(
    name: str,
    out: Path,
    plan: Plan,
    listen: str,
    connect: Sequence[str] | None,
    network: str,
    seed: int,
    expect: int | None,
    speed: float,
    quiet: bool,
) -> None:
    """Run a robot of this name once more, into a new folder, or end the command with what went wrong."""
    try:
        check_chunk("robot", name)
        check_speed(speed)
        place = Place(listen, tuple(connect or ()), network_named(network), seed)
    except ValueError as error:
        fail(error, EXIT_USAGE)
    config = RunConfig(robot=name, out=out, sender=sender_name(), plan=plan, expect=expect)
    with Terminal(quiet) as terminal:
        run_attended(config, place, speed, terminal, "")
