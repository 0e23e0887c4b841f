"""What an attendant says, with the time of day, on standard output; and as JSON lines.

Where that is quiet, or taken by the lines of JSON, what warns of motion is on standard error.
"""

from datetime import datetime
from pathlib import Path

from rich.console import Console

from coordinator.monitoring.monitor import MonitorUpdate
from coordinator.runtime.terminal import Displayed, JsonLines, Terminal


class AttendScreen(Displayed):
    """Shows sentences as they come; times are the session's, nanoseconds since 1970."""

    def __init__(self, json_file: Path | None, quiet: bool = False):
        self._lines = JsonLines(json_file)
        super().__init__(Console(highlight=False, quiet=quiet or self._lines.to_standard_output), None)

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        self._lines.close()

    def say(self, text: str, t_ns: int) -> None:
        """Show a sentence of the attendant."""
        self._print(self.console, text, t_ns)
        self._lines.write({"t_ns": t_ns, "says": text})

    def warn(self, text: str, t_ns: int) -> None:
        """Show a warning that the robot is about to move, whatever is quiet."""
        self._print(Terminal().console if self.console.quiet else self.console, text, t_ns)
        self._lines.write({"t_ns": t_ns, "says": text})

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None:
        """Show that a step of a measurement begins."""
        self.note(f"[{index}/{total}] {text}")

    def report(self, update: MonitorUpdate) -> None:
        """Show what the monitor finds; what hinders it goes to the JSON lines only."""
        for note in update.notes:
            self._lines.write({"note": note})
        for finding in update.findings:
            over = "" if finding.until_ns is None or finding.kind == "collision" else ", over now"
            self._print(self.console, f"{finding.kind}: {finding.summary}{over}", finding.reported_ns)
            self._lines.write({"finding": finding.model_dump()})
        for key in update.withdrawn:
            self._lines.write({"withdrawn": list(key)})

    @staticmethod
    def _print(console: Console, text: str, t_ns: int) -> None:
        at = datetime.fromtimestamp(1e-9 * t_ns).astimezone()
        console.print(f"{at:%Y-%m-%d %H:%M:%S}  {text}", markup=False, soft_wrap=True)
