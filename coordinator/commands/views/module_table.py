"""All modules of a robot in a live table; lines in a pipe; lines of JSON for programs."""

from collections.abc import Sequence
from math import degrees
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from coordinator.monitoring.module_states import ModuleState
from coordinator.runtime.terminal import Displayed, JsonLines, figure, new_table

_NOTES = 3
# Seconds between lines in a pipe, and lines of JSON.
LINE_S = 1.0
_COLUMNS = (
    "module | name | type | state | holder | >position [deg] | >speed [deg/s] | >effort [Nm] | "
    ">winding [°C] | >[V] | >rows/s | >lost | >delay p50 [ms] | >p99 | refused"
)
_STYLES = {
    "idle": "dim",
    "armed": "cyan",
    "moving": "green",
    "streaming": "green",
    "expired": "yellow",
    "stopped": "yellow",
    "fault": "bold red",
    "silent": "red",
    "gone": "red",
}


class ModuleScreen(Displayed):
    """Shows states of modules; a note stays below the table. `keys` says which keys there are."""

    def __init__(self, robot: str, json_file: Path | None, quiet: bool, keys: str):
        self._robot = robot
        self._keys = keys
        self._lines = JsonLines(json_file)
        self._states: Sequence[ModuleState] = ()
        self._notes: list[str] = []
        self._due_s = 0.0
        console = Console(highlight=False, quiet=quiet or self._lines.to_standard_output)
        self._live = Live(get_renderable=self._shown, console=console, auto_refresh=False)
        super().__init__(console, self._live)

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        self._lines.close()

    def show(self, states: Sequence[ModuleState], since_s: float) -> None:
        """Show the states at a time since the beginning [s]."""
        self._states = states
        if self._display is not None:
            self._live.refresh()
        if since_s < self._due_s:
            return
        self._due_s = since_s + LINE_S
        for state in states:
            self._lines.write({"t_s": round(since_s, 3), **fields(state)})
        if self._display is None:
            for state in states:
                self.console.print(f"{since_s:7.1f} s  {line(state)}", markup=False, soft_wrap=True)

    def note(self, text: str) -> None:
        """Show a line of text."""
        if self._display is None:
            super().note(text)
        else:
            self._notes = [*self._notes, text][-_NOTES:]
            self._live.refresh()

    def _shown(self) -> Group:
        below = [Text(note, style="yellow") for note in self._notes]
        return Group(table(self._robot, self._states), *below, Text(self._keys, style="dim"))


def fields(state: ModuleState) -> dict[str, object]:
    """Return a state for programs; units in the names."""
    plain, delay = state._asdict(), state.delay
    del plain["delay"]
    known = ("p50_ms", "p99_ms", "clock_sigma_ms")
    delays = {f"delay_{name}": None if delay is None else getattr(delay, name) for name in known}
    return {**plain, **delays, "refused": dict(state.refused)}


def line(state: ModuleState) -> str:
    """Return a state in one line."""
    p50, p99 = _delays(state)
    return (
        f"{state.serial} {state.state}: {_angle(state.position_rad, 'z.2f')} deg, "
        f"{figure(state.effort_nm, 'z.2f')} Nm, {state.rows_per_s:.0f} rows/s, {state.lost_rows} lost, "
        f"delay {p50} ms, p99 {p99} ms"
    )


def table(robot: str, states: Sequence[ModuleState]) -> Table:
    """Return the states as a table."""
    there = sum(state.state not in ("gone", "silent") for state in states)
    shown = new_table(f"{robot}: {there} of {len(states)} modules", _COLUMNS, header_style="bold")
    for state in states:
        shown.add_row(
            state.serial,
            state.name or "-",
            state.kind or "-",
            Text(state.state, style=_STYLES.get(state.state, "")),
            _short(state.holder),
            _angle(state.position_rad, "z.2f"),
            _angle(state.velocity_rad_s, "z.1f"),
            figure(state.effort_nm, "z.2f"),
            figure(state.winding_temperature_c, ".1f"),
            figure(state.voltage_v, ".1f"),
            f"{state.rows_per_s:.0f}",
            Text(str(state.lost_rows), style="red" if state.lost_rows else ""),
            *_delays(state),
            ", ".join(f"{reason} {count}" for reason, count in state.refused.items()) or "-",
        )
    return shown


def _delays(state: ModuleState) -> tuple[str, str]:
    delay = state.delay
    return ("-", "-") if delay is None else (delay.shown(delay.p50_ms), delay.shown(delay.p99_ms))


def _angle(value_rad: float | None, form: str) -> str:
    return figure(None if value_rad is None else degrees(value_rad), form)


def _short(holder: str | None) -> str:
    """Return the program and its process; the host and what makes the name unique are in the JSON."""
    return "-" if holder is None else holder.partition("@")[0]
