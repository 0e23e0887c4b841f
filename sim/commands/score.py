"""`x5-sim score`: a run's result against the simulator's truth."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from coordinator.commands.options import JsonFile
from coordinator.dynamics.torque_prediction import FAINT_NM
from coordinator.runtime.terminal import figure, new_table, print_table, write_result
from module_agent.model.files import write_json
from sim.scoring.score import Score, score


def score_run(
    folder: Annotated[Path, typer.Argument(help="Folder of a run.")],
    json_file: JsonFile = None,
) -> None:
    """Compare a run's result with the simulator's truth."""
    result = score(folder)
    write_json(folder / "score.json", result)
    if write_result(json_file, result):
        print_table(table(result))


def table(result: Score) -> Table:
    """Return the score as a table to print."""
    unidentifiable = "\n".join(f"Not identifiable: {summary}" for summary in result.unidentifiable)
    shown = new_table(
        "Result against truth",
        " | >truth | >error | >claimed sigma | >axis error",
        caption=unidentifiable or None,
        caption_justify="left",
    )
    shown.add_row("topology", "", "correct" if result.topology_correct else "WRONG", "", "")
    for line in result.topology_differences:
        shown.add_row(f"  {line}", "", "", "", "")
    for link in result.links:
        shown.add_row(
            f"link {link.parent} - {link.child}",
            f"{link.link_length_true_mm:.2f} mm",
            figure(link.link_length_error_mm, "+.2f", " mm"),
            figure(link.link_length_sigma_mm, ".2f", " mm"),
            figure(link.axis_error_deg, ".3f", " deg"),
        )
    shown.add_section()
    for name, error, sigma, form, unit in (
        ("tip position, rms", result.tip_position_rms_mm, result.tip_position_sigma_mm, ".2f", " mm"),
        (
            "tip orientation, rms",
            result.tip_orientation_rms_deg,
            result.tip_orientation_sigma_deg,
            ".3f",
            " deg",
        ),
        ("direction of gravity", result.gravity_error_deg, None, ".3f", " deg"),
    ):
        shown.add_row(name, "", figure(error, form, unit), figure(sigma, form, unit), "")
    _add_torques(shown, result)
    shown.add_section()
    shown.add_row("robot time", figure(result.robot_time_s, ".1f", " s"), "", "", "")
    shown.add_row("wall time", figure(result.wall_time_s, ".1f", " s"), "", "", "")
    return shown


def _add_torques(shown: Table, result: Score) -> None:
    """Add rows of rms torques [Nm]; percentages only of torques that are no noise."""

    def row(what: str, error_nm: float | None, torque_nm: float | None) -> None:
        error = figure(error_nm, ".3f", " Nm")
        if error_nm is not None and torque_nm is not None and torque_nm >= FAINT_NM:
            error += f" ({error_nm / torque_nm:.2%})"
        shown.add_row(what, figure(torque_nm, ".3f", " Nm"), error, "", "")

    def absolute(relative: float | None, torque_nm: float | None) -> float | None:
        return None if relative is None or torque_nm is None else relative * torque_nm

    true_nm, measured_nm = result.torque_rms_nm, result.measured_torque_rms_nm
    row("held-out torque against the true, rms", absolute(result.torque_relative_error, true_nm), true_nm)
    torques = result.torque_rms_nm_per_joint or {}
    for serial, error_nm in (result.torque_rms_error_nm_per_joint or {}).items():
        row(f"  of {serial}", error_nm, torques.get(serial))
    measured = absolute(result.torque_relative_error_measured, measured_nm)
    row("held-out torque against the measured, rms", measured, measured_nm)
