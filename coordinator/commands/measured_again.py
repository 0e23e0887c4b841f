"""`x5-coordinator check` and `payload`: a robot measured again, against an earlier run of it."""

from collections.abc import Callable

import numpy as np
import typer

from coordinator.baseline.baseline_robot import BaselineRobot, load_baseline
from coordinator.baseline.check import CheckReport, check, check_plan, write_check
from coordinator.baseline.payload import payload_plan, search_payload, write_payload
from coordinator.commands.options import (
    AgainOptions,
    BaselineFolder,
    ConnectOptions,
    DynamicsFolder,
    JsonFile,
    planned,
)
from coordinator.commands.run import run_attended
from coordinator.excitation.plan import Plan
from coordinator.live_robot.connection import new_sender
from coordinator.recording.run_folder import RESULT
from coordinator.runtime.command_line import end_if_suspect, with_options
from coordinator.runtime.terminal import Terminal, new_table, print_table, write_result
from coordinator.session.run import RunConfig
from coordinator.torque_control.gravity_model import read_result
from module_agent.model.errors import EXIT_FINDING, UsageError

CHECK, PAYLOAD = "check.json", "payload.json"


@with_options
def check_robot(
    baseline: BaselineFolder, at: ConnectOptions, again: AgainOptions, json_file: JsonFile = None
) -> None:
    """Measure a robot again in a short run, and say which of its links changed since an earlier run.

    Writes check.json. Exit codes: 0 nothing changed, 4 a link or the modules changed, 5 in either run a
    module took no part, sensors are faulty or the recording is damaged, so that changes may not be the
    robot's, others as of `run`.
    """
    before = load_baseline(baseline)
    after = measured_again(before, at, again, check_plan)
    report = check(before, after)
    write_check(after.folder / CHECK, report)
    if write_result(json_file, report):
        _print(report)
    end_if_suspect([*before.kinematics.suspicions, *after.kinematics.suspicions])
    if report.changed:
        raise typer.Exit(EXIT_FINDING)


def _print(report: CheckReport) -> None:
    table = new_table(
        f"{report.robot} against {report.baseline}",
        "parent | child | >displaced [mm] | >+- | >turned [deg] | >+- | >false alarm | ",
    )
    for link in report.links:
        table.add_row(
            link.parent,
            link.child,
            f"{link.length_mm:.2f}",
            f"{link.length_sigma_mm:.2f}",
            f"{np.linalg.norm(link.rotation_deg):.3f}",
            f"{max(link.rotation_sigma_deg):.3f}",
            f"{link.false_alarm_probability:.1g}",
            "changed" if link.changed else "",
        )
    if report.links:
        print_table(table)
    typer.echo("\n".join(report.summary))


@with_options
def find_payload(
    baseline: DynamicsFolder, at: ConnectOptions, again: AgainOptions, json_file: JsonFile = None
) -> None:
    """Move a robot for some ten seconds, and identify its payload: mass, centre, inertia, and where it is.

    Writes payload.json. Exit codes: 0 also without a payload, others as of `run`.
    """
    # Before the robot is moved, and before seconds of work.
    if (baseline / RESULT).is_file() and read_result(baseline).dynamics is None:
        raise UsageError(
            f"{baseline} has no inertia: its run had --no-dynamics, or ended with code 5. A payload is what "
            "is more than a known inertia; identify the robot with dynamics first"
        )
    before = load_baseline(baseline)
    after = measured_again(before, at, again, payload_plan)
    report = search_payload(before, after)
    write_payload(after.folder / PAYLOAD, report)
    if write_result(json_file, report):
        typer.echo("\n".join(report.summary))
    end_if_suspect([*before.kinematics.suspicions, *after.kinematics.suspicions])


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
        given = {"--expect": again.expect, "--plan": again.plan, "--speed": again.speed != 1.0}
        if moot := [option for option, value in given.items() if value]:
            raise UsageError(f"{', '.join(moot)} is of a new run: --measured compares with a finished one")
        return load_baseline(again.measured)
    if again.out is None or again.measured is not None:
        raise UsageError("give either --out, to measure the robot, or --measured, a run to compare with")
    place = at.place(before.name)
    short = plan(before, planned(again.plan))
    config = RunConfig(robot=place.robot, out=again.out, sender=new_sender(), plan=short, expect=again.expect)
    with Terminal(at.quiet) as terminal:
        return run_attended(config, place, again.speed, terminal, advice="")[1]
