"""A run at a terminal: signals, and the report of a run that ends early."""

from pathlib import Path

from coordinator.baseline.baseline_robot import BaselineRobot
from coordinator.commands.options import ConnectOptions
from coordinator.excitation.plan import Plan
from coordinator.identification.result import Result
from coordinator.live_robot.connection import Place, open_connection, sender_name
from coordinator.recording.session_file import SessionFileError
from coordinator.runtime.command_line import fail
from coordinator.runtime.event_loop import (
    SIGNALS,
    Interruption,
    ScaledLoop,
    check_speed,
    ignore_signals,
    run_to_end,
)
from coordinator.runtime.exit_codes import explain
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
    loop = ScaledLoop(speed)
    interruption: Interruption | None = None
    try:
        work = _prepared(config, place, loop, terminal)
        task = loop.create_task(work.run())
        interruption = Interruption(loop, task)
        for number in SIGNALS:
            loop.add_signal_handler(number, interruption)
        try:
            return run_to_end(loop, task), work.robot
        except BaseException as error:
            failure = explain(error)
            if failure is None:
                raise
            ended = f"{failure.text}; {work.standstill}; recorded up to here: {config.out}"
            fail("\n".join((ended, advice)).rstrip(), failure.exit_code)
    finally:
        loop.run_until_complete(loop.shutdown_default_executor())
        # Closing hands the signals back to Python.
        loop.close()
        if interruption is not None and interruption.requested:
            ignore_signals()


def _prepared(config: RunConfig, place: Place, loop: ScaledLoop, terminal: Terminal) -> Run:
    """Open everything, or nothing."""
    transport = open_connection(place, terminal.note).transport
    try:
        return Run(config, transport, loop.clock_ns, loop.call_soon_threadsafe, terminal)
    except BaseException as error:
        transport.close()
        if isinstance(error, SessionFileError | OSError):
            raise UsageError(str(error)) from error
        raise


def run_short(
    baseline: BaselineRobot, at: ConnectOptions, out: Path, plan: Plan, expect: int | None, speed: float
) -> BaselineRobot:
    """Run the robot of a baseline once more, into a new folder; raises as `run_attended`."""
    place = at.place(baseline.name)
    config = RunConfig(robot=place.robot, out=out, sender=sender_name(), plan=plan, expect=expect)
    with Terminal(at.quiet) as terminal:
        return run_attended(config, place, check_speed(speed), terminal, advice="")[1]
