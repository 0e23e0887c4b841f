"""`x5-coordinator merge`: combine what several runs with the same modules measured."""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.commands.options import JsonFile
from coordinator.merge.calibration_file import each_once, read_calibration, write_calibration
from coordinator.merge.information_file import read_information
from coordinator.merge.merge_calibrations import merge_calibrations
from coordinator.merge.merge_runs import merge_runs
from coordinator.merge.report import MERGED, MergeReport, merge_report
from coordinator.recording.run_folder import CALIBRATION, INFORMATION, RESULT, SESSION
from coordinator.runtime.command_line import end_if_suspect
from coordinator.runtime.terminal import new_table, print_table, write_result
from module_agent.model.errors import UsageError
from module_agent.model.files import write_json

# Above this the robot was not the same in all runs, or the covariance of a chain is too small.
INCONSISTENT_ABOVE = 5.0


def merge(
    runs: Annotated[list[Path], typer.Argument(help="Folders of two or more runs, with dynamics.")],
    out: Annotated[Path, typer.Option(help="Folder for merged.json and imu_calibration.npz.")],
    json_file: JsonFile = None,
) -> None:
    """Combine what several runs measured of the same modules: inertial parameters, and the places of IMUs.

    The robot may be assembled differently in every run: in another order, on another base, with further
    modules. Each link must stay with the module that it leads to. `run --measured OUT` begins with the IMUs.
    Exit code 5: one of the runs, or of those that they began with, ended with code 5 itself.
    """
    if len(runs) < 2:
        raise UsageError("give two or more runs: the parameters of a single one are in its result.json")
    if any((out / file).exists() for file in (SESSION, RESULT)) or out.resolve() in [
        run.resolve() for run in runs
    ]:
        raise UsageError(
            f"{out} is the folder of a run, whose {CALIBRATION} would be lost; give another --out"
        )
    files = [run / CALIBRATION for run in runs]
    # Runs of earlier versions have none.
    recordings = [read_calibration(file) if file.is_file() else () for file in files]
    imus = merge_calibrations(recordings)
    everything = each_once(one for run in recordings for one in run)
    folders = {own[0].session: run.name for own, run in zip(recordings, runs, strict=True) if own}
    suspicions = [
        f"{folders.get(one.session, one.name)}: {why}" for one in everything for why in one.suspicions
    ]
    merged = merge_runs([read_information(run / INFORMATION) for run in runs])
    report = merge_report(merged, imus, suspicions)
    out.mkdir(parents=True, exist_ok=True)
    write_calibration(out / CALIBRATION, everything)
    write_json(out / MERGED, report)
    if write_result(json_file, report):
        _print(report)
    end_if_suspect(suspicions)


def _print(report: MergeReport) -> None:
    table = new_table(
        f"{report.rank} of {report.parameters} parameters of {len(report.parts)} parts",
        "run | modules | rank | below 10 % | below 10 %, merged | sigma merged / alone | "
        "inconsistency [sigma] | of IMUs [sigma]",
    )
    for run in report.runs:
        table.add_row(
            run.run,
            ", ".join(run.serials),
            str(run.rank),
            str(run.identified_alone),
            str(run.identified_merged),
            f"{run.gain:.2f}",
            f"{run.inconsistency_sigma:.1f}",
            "" if run.imu_inconsistency_sigma is None else f"{run.imu_inconsistency_sigma:.1f}",
        )
    table.add_row("merged", "", str(report.rank), "", "", f"{report.gain:.2f}", "", "")
    print_table(table)
    for run in report.runs:
        if run.inconsistency_sigma > INCONSISTENT_ABOVE:
            typer.echo(
                f"{run.run} disagrees with the other runs by {run.inconsistency_sigma:.0f} sigma (at "
                f"most {INCONSISTENT_ABOVE:.0f} expected): a part or a link differs, or the covariance of "
                "its chain is too small"
            )
