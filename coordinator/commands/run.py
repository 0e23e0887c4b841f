"""`x5-coordinator run` and `replay`: a robot identifies itself, and again from its recording."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from coordinator.baseline.baseline_robot import BaselineRobot, baseline_within, measured_before_run
from coordinator.commands.options import (
    ConnectOptions,
    Expect,
    JsonFile,
    LiveViewer,
    PlanOptions,
    ServePort,
    Speed,
    WithReport,
)
from coordinator.commands.view import live_page
from coordinator.identification.identify import identify
from coordinator.identification.result import DynamicsPart, Result
from coordinator.live_robot.connection import Place, new_sender, open_connection
from coordinator.recording.run_folder import REPORT, SESSION, load_recording
from coordinator.recording.session_file import SessionFileError
from coordinator.report.plots import MissingPlots
from coordinator.report.run_report import write_report
from coordinator.runtime.command_line import ENDINGS, end_if_suspect, ending, fail, with_options
from coordinator.runtime.event_loop import ScaledLoop, attend
from coordinator.runtime.terminal import Terminal, figure, new_table, write_result
from coordinator.session.run import Run, RunConfig, write_outputs
from coordinator.viewer.targets import SERVE_PORT, viewer_choice
from module_agent.model.errors import UsageError


@with_options
def run(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="Folder of the run; it must be new.")],
    at: ConnectOptions,
    settings: PlanOptions,
    expect: Expect = None,
    baseline: Annotated[
        Path | None,
        typer.Option(
            help="Folder of an earlier run of this robot: only joints that differ are explored again."
        ),
    ] = None,
    measured: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of an earlier run or merge with some of these modules, in any assembly: it gives "
            "the prior of their IMUs; repeat for several."
        ),
    ] = None,
    viewer: LiveViewer = "none",
    serve_port: ServePort = SERVE_PORT,
    max_disk: Annotated[
        float, typer.Option(min=1e-3, help="End, the robot stopped, when the recording has so many GB.")
    ] = 20.0,
    resume: Annotated[bool, typer.Option(help="Continue the crashed run in --out.")] = False,
    speed: Speed = 1.0,
    report: WithReport = True,
    json_file: JsonFile = None,
    advise: Annotated[
        bool, typer.Option("--advise/--no-advise", hidden=True, help="Say how to resume a run that ended.")
    ] = True,
) -> None:
    """Discover a robot, move its joints, and identify topology, kinematic chain and inertia.

    --json writes the same document as result.json. With --viewer serve its page is served on after the end,
    until Ctrl-C.
    Exit codes: 0 identified; 1 the run failed; 2 wrong usage; 3 a module was lost; 5 a module took no part or
    sensors are faulty, and the result is without these modules, or there is none; 130 interrupted.
    """
    place = at.place()
    config = RunConfig(
        robot=place.robot,
        out=out,
        sender=new_sender(),
        plan=settings.chosen(),
        expect=expect,
        resume=resume,
        viewer=viewer_choice(viewer, serve_port),
        baseline=baseline,
        measured=tuple(measured or ()),
        report=report,
        max_bytes=round(1e9 * max_disk),
    )
    advice = f"to resume: {resuming(context)}" if advise else ""
    with live_page(viewer, serve_port) as stay:
        with Terminal(at.quiet) as terminal:
            result, _ = run_attended(config, place, speed, terminal, advice)
        print_result(result, terminal)
        write_result(json_file, result)
        terminal.console.print(f"written to {out}{report_at(out)}", markup=False, soft_wrap=True)
        stay()
    end_if_suspect(result.suspicions)


def replay(
    session: Annotated[Path, typer.Argument(help="A session.mcap, or the folder of a run.")],
    out: Annotated[Path | None, typer.Option(help="Folder for result.json [folder of the session].")] = None,
    report: WithReport = True,
    json_file: JsonFile = None,
) -> None:
    """Compute the result of a run again from its recording, without a robot.

    Exit codes: 5 a module took no part, sensors are faulty or the recording is damaged, others as of `run`.
    """
    session = session / SESSION if session.is_dir() else session
    if not session.is_file():
        raise UsageError(f"{session}: there is no such recording")
    folder = out if out is not None else session.parent
    steps = 3 if report else 2
    with Terminal() as terminal:
        terminal.step(1, steps, f"reading {session}")
        recording = load_recording(session)
        # Before anything is identified: where that fails this may be why.
        for sentence in (*recording.damage, *recording.remarks):
            terminal.note(sentence)
        terminal.step(2, steps, "identifying the robot")
        before = baseline_within(session.parent)
        revise = before.updated if before is not None else None
        identified = identify(recording, revise=revise, measured=measured_before_run(session.parent, before))
        folder.mkdir(parents=True, exist_ok=True)
        write_outputs(folder, identified)
        if report:
            terminal.step(3, steps, "writing the report")
            try:
                write_report(folder, recording, identified.result)
            except MissingPlots as error:
                terminal.note(f"no report: {error}")
    print_result(identified.result, terminal)
    write_result(json_file, identified.result)
    terminal.console.print(f"written to {folder}{report_at(folder)}", markup=False, soft_wrap=True)
    end_if_suspect(identified.result.suspicions)


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
        ended = f"{end}; {work.standstill}; recorded up to here: {config.out}{report_at(config.out)}"
        fail("\n".join((ended, advice)).rstrip(), end.exit_code)


def report_at(folder: Path) -> str:
    """Return where the report of a run is, as the end of a line; nothing if it has none."""
    return f"; report: {folder / REPORT}" if (folder / REPORT).is_file() else ""


def resuming(context: typer.Context) -> str:
    """Return the command that resumes a run: the options that were given, with `--resume`."""
    words = ["x5-coordinator", "run"]
    for option in context.command.params:
        name = option.name or ""
        source = context.get_parameter_source(name)
        if source is None or source.name != "COMMANDLINE" or name == "resume":
            continue
        value = context.params[name]
        if isinstance(value, bool):
            words.append((option.opts if value else option.secondary_opts)[0])
        else:
            for one in value if isinstance(value, list | tuple) else [value]:
                words += [option.opts[0], str(one)]
    return shlex.join([*words, "--resume"])


def print_result(result: Result, terminal: Terminal) -> None:
    """Print the links, what is not identifiable, and how well the inertial parameters predict."""
    table = new_table(f"{result.robot}: links", "parent | child | axis to IMU [mm] | +-")
    for link in result.links:
        sigma = link.link_length_sigma_mm
        length = None if sigma is None else link.link_length_mm
        table.add_row(link.parent, link.child, figure(length, ".1f"), figure(sigma, ".1f"))
    terminal.console.print(table)
    for item in result.unresolved:
        terminal.note(f"not identifiable: {item.summary}")
    if result.dynamics is not None:
        _print_inertia(result.dynamics, terminal)
    terminal.note(f"trace hash {result.trace_hash}")


def _print_inertia(dynamics: DynamicsPart, terminal: Terminal) -> None:
    for line in dynamics.summary:
        terminal.note(line)
    if dynamics.held_out is None:
        return
    real = dynamics.bodies.held_out_relative_error if dynamics.bodies is not None else None
    terminal.note(
        f"inertia: {dynamics.rank} of {dynamics.parameters} parameters; error of predicted torque on "
        f"held-out motions, rms: {dynamics.held_out.in_words()}"
        + ("" if real is None else f", by the bodies in the URDF: {dynamics.held_out.in_words(real)}")
    )
