"""Findings of the monitor: below live tables on a terminal, lines in a pipe; and a JSON file."""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from coordinator.commands.views.module_table import table as module_table
from coordinator.monitoring.findings import Finding, Key
from coordinator.monitoring.module_states import ModuleState
from coordinator.monitoring.monitor import Monitor, MonitorUpdate
from coordinator.runtime.terminal import Displayed, JsonLines, new_table

_NOTES = 6


class MonitorScreen(Displayed):
    """Shows what a watcher says. Times are seconds since `start_ns`, which is set before anything is said.

    `keys` says which keys there are, below all modules, if `show_modules` is given any.
    """

    def __init__(self, monitor: Monitor, json_file: Path | None, quiet: bool = False, keys: str = ""):
        self.start_ns = 0
        self._monitor = monitor
        self._keys = keys
        self._states: Sequence[ModuleState] = ()
        self._notes: list[str] = []
        self._lines = JsonLines(json_file)
        console = Console(highlight=False, quiet=quiet or self._lines.to_standard_output)
        self._live = Live(get_renderable=self._shown, console=console, refresh_per_second=4.0)
        super().__init__(console, self._live)

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        self._lines.close()

    def show_modules(self, states: Sequence[ModuleState]) -> None:
        """Show all modules on the network above what is found; on a terminal only."""
        self._states = states

    def note(self, text: str) -> None:
        """Show a line of text."""
        if self._display is None:
            super().note(text)
        else:
            self._notes = [*self._notes, text][-_NOTES:]

    def report(self, update: MonitorUpdate) -> None:
        """Show what is new."""
        for note in update.notes:
            self._line(note)
            self._write({"note": note})
        for finding in update.findings:
            self._line(self.sentence(finding))
            self._write({"finding": finding.model_dump()})
        for key in update.withdrawn:
            self._line(f"withdrawn: {_named(key, self.start_ns)}; explained by the finding above")
            self._write({"withdrawn": list(key)})

    def show_summary(self) -> None:
        """Show all that was found, as it is held at the end."""
        found, monitor = self._monitor.finding_log.all, self._monitor
        all_findings = [finding.model_dump() for finding in found]
        self._write({"monitored_s": round(monitor.monitored_s, 3), "findings": all_findings})
        if self._display is not None:
            self._live.refresh()
            return
        self.console.print(f"monitored for {monitor.monitored_s:.1f} s", markup=False)
        for line in [self.sentence(finding) for finding in found] or ["no findings"]:
            self.note(line)

    def sentence(self, finding: Finding) -> str:
        """Return a finding in a line."""
        since = 1e-9 * (finding.since_ns - self.start_ns)
        sure = f"{finding.gain:.0f} against {finding.level:.0f}" if finding.kind != "collision" else ""
        over = "" if finding.until_ns is None or finding.kind == "collision" else ", over now"
        return f"{since:8.2f} s  {finding.kind}: {finding.summary}{f' ({sure})' if sure else ''}{over}"

    def _line(self, text: str) -> None:
        if self._display is None:
            self.console.print(text, markup=False, soft_wrap=True)
        else:
            self.note(text)

    def _write(self, what: dict[str, object]) -> None:
        self._lines.write(what)

    def _shown(self) -> Group:
        monitor, outside = self._monitor, self._monitor.outside_nm
        table = new_table(
            f"{monitor.monitored_s:.0f} s monitored", "joint | external torque [Nm] | threshold [Nm]"
        )
        for k, serial in enumerate(monitor.reference.chain.serials):
            now = "-" if outside is None else f"{outside[k]:+.2f}"
            table.add_row(serial, now, f"{monitor.thresholds.contact_nm[k]:.2f}")
        findings = [self.sentence(finding) for finding in monitor.finding_log.all]
        below = map(Text, [*findings, *self._notes])
        if not self._states:
            return Group(table, *below)
        modules = module_table(monitor.reference.name, self._states)
        return Group(modules, table, *below, Text(self._keys, style="dim"))


def _named(key: Key, start_ns: int) -> str:
    kind, at = key
    if isinstance(at, int) and at:
        return f"the {kind} of {1e-9 * (at - start_ns):.2f} s"
    return "a payload, or unexplained torques" if kind == "load" else f"{kind} {at}"
