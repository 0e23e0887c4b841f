"""Gravity compensation in the terminal: a live table, plain lines in a pipe, or lines of JSON."""

from collections.abc import Callable
from math import degrees
from pathlib import Path

from rich.console import Console, RenderableType
from rich.live import Live
from rich.table import Table

from coordinator.runtime.terminal import Displayed, JsonLines, new_table, print_table
from coordinator.torque_control.session import Moment
from coordinator.torque_control.summary import CompensationSummary

# Update intervals of the live table and of lines in a pipe.
LIVE_S, LINE_S = 0.25, 0.5


class CompensationView(Displayed):
    """Shows moments at intervals; `now_s` is the clock of the session.

    Use as a context manager. Notes, and what is live, go to standard error, the summary to standard output;
    lines of JSON to `json_file`, where - is standard output and takes the place of the others.
    """

    def __init__(
        self, serials: tuple[str, ...], now_s: Callable[[], float], json_file: Path | None, quiet: bool
    ):
        self._serials = serials
        self._now_s = now_s
        self._lines, self._quiet = JsonLines(json_file), quiet
        console = Console(stderr=True, highlight=False, quiet=quiet)
        self._live = Live(console=console, auto_refresh=False, transient=True)
        super().__init__(console, None if self._lines.to_standard_output else self._live)
        self._due_s = 0.0

    def moment(self, now: Moment) -> None:
        """Show a moment, if the interval is over."""
        now_s = self._now_s()
        if now_s < self._due_s:
            return
        self._due_s = now_s + (LIVE_S if self._display is not None else LINE_S)
        self._lines.write(moment_fields(self._serials, now))
        if self._lines.to_standard_output:
            return
        if self._display is not None:
            self._live.update(moment_table(self._serials, now), refresh=True)
        else:
            self.console.print(moment_line(self._serials, now), markup=False, soft_wrap=True)

    def summary(self, found: CompensationSummary) -> None:
        """Print the summary."""
        self._lines.write(summary_fields(found))
        self._lines.close()
        if not self._quiet and not self._lines.to_standard_output:
            print_table(summary_table(found))


def moment_fields(serials: tuple[str, ...], now: Moment) -> dict[str, object]:
    """Return a moment for programs; SI units."""
    reading = now.reading
    arrays = (reading.q_rad, reading.qd_rad_s, now.effort_nm, reading.effort_nm, reading.age_s)
    columns = zip(serials, *(array.tolist() for array in arrays), strict=True)
    names = "serial", "position_rad", "velocity_rad_s", "commanded_nm", "measured_nm", "age_s"
    return {
        "phase": now.phase,
        "compensated_s": round(now.compensated_s, 3),
        "missed": now.missed,
        "joints": [dict(zip(names, row, strict=True)) for row in columns],
    }


def moment_line(serials: tuple[str, ...], now: Moment) -> str:
    """Return a moment in one line: degrees and newton metres by joint."""
    joints = ", ".join(
        f"{serial} {degrees(q):.1f} deg {tau:.2f} Nm"
        for serial, q, tau in zip(serials, now.reading.q_rad, now.effort_nm, strict=True)
    )
    return f"{now.phase} {now.compensated_s:.1f} s: {joints}"


def moment_table(serials: tuple[str, ...], now: Moment) -> RenderableType:
    """Return a moment as a table."""
    shown = new_table(
        f"{now.phase}, {now.compensated_s:.1f} s, {now.missed} set-points missed",
        "joint | position [deg] | speed [deg/s] | commanded [Nm] | measured [Nm] | age [ms]",
    )
    reading = now.reading
    for k, serial in enumerate(serials):
        shown.add_row(
            serial,
            f"{degrees(reading.q_rad[k]):.1f}",
            f"{degrees(reading.qd_rad_s[k]):.1f}",
            f"{now.effort_nm[k]:.2f}",
            f"{reading.effort_nm[k]:.2f}",
            f"{1e3 * reading.age_s[k]:.0f}",
        )
    return shown


def summary_fields(found: CompensationSummary) -> dict[str, object]:
    """Return a summary for programs; SI units."""
    return {**found._asdict(), "joints": [joint._asdict() for joint in found.joints]}


def summary_table(found: CompensationSummary) -> Table:
    """Return a summary as a table."""
    shown = new_table(
        f"compensated for {found.compensated_s:.1f} s: {found.why}; {found.missed} set-points missed",
        "joint | moved [deg] | farthest [deg] | top speed [deg/s] | torque, rms [Nm] | max [Nm]",
    )
    for joint in found.joints:
        shown.add_row(
            joint.serial,
            f"{degrees(joint.end_rad - joint.start_rad):+.1f}",
            f"{degrees(joint.farthest_rad):.1f}",
            f"{degrees(joint.top_speed_rad_s):.1f}",
            f"{joint.effort_rms_nm:.2f}",
            f"{joint.effort_max_nm:.2f}",
        )
    return shown
