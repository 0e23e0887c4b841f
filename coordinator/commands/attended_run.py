"""A run at a terminal: signals, and the report of a run that ends early."""

from collections.abc import Callable

from coordinator.baseline.baseline_robot import BaselineRobot, load_baseline
from coordinator.commands.options import AgainOptions, ConnectOptions, planned
from coordinator.excitation.plan import Plan
from coordinator.identification.result import Result
from coordinator.live_robot.connection import Place, open_connection, sender_name
from coordinator.recording.session_file import SessionFileError
from coordinator.runtime.command_line import ENDINGS, ending, fail
from coordinator.runtime.event_loop import ScaledLoop, attend
from coordinator.runtime.terminal import Terminal
from coordinator.session.run import Run, RunConfig
from module_agent.model.errors import UsageError


def run_attended(
    config: RunConfig, place: Place, speed: float, terminal: Terminal, advice: str
) -> tuple[Result, BaselineRobot]:
    """Run to the end, and return the result and the robot; a first signal stops the robot in order.

    Raises:
        CommandFailed: the run ended early; the text says why, what is recorded, and the advice.
        UsageError: the run cannot begin.
    """
    transport = open_connection(place, terminal.note).transport
    loop = ScaledLoop(speed)
    try:
        work = Run(config, transport, loop.clock_ns, loop.call_soon_threadsafe, terminal)
    except BaseException as error:
        transport.close()
        loop.close()
        if isinstance(error, SessionFileError | OSError):
            raise UsageError(str(error)) from error
        raise
    try:
        return attend(loop, work.run()), work.robot
    except ENDINGS as error:
        end = ending(error)
        ended = f"{end}; {work.standstill}; recorded up to here: {config.out}"
        fail("\n".join((ended, advice)).rstrip(), end.exit_code)


def measured_again(
    before: BaselineRobot,
    at: ConnectOptions,
    again: AgainOptions,
    plan: Callable[[BaselineRobot, Plan], Plan],
) -> BaselineRobot:
    """Return the robot of a baseline as it is now: by a short run of this plan, or as of a finished run.

    Raises:
        UsageError: neither is chosen, or both; otherwise as `run_attended`.
    """
    if again.out is None and again.measured is not None:
        return load_baseline(again.measured)
    if again.out is None or again.measured is not None:
        raise UsageError("give either --out, to measure the robot, or --measured, a run to compare with")
    place = at.place(before.name)
    short = plan(before, planned(again.plan))
    config = RunConfig(
        robot=place.robot, out=again.out, sender=sender_name(), plan=short, expect=again.expect
    )
    with Terminal(at.quiet) as terminal:
        return run_attended(config, place, again.speed, terminal, advice="")[1]
