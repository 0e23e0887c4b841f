"""`x5-coordinator monitor FOLDER` on a terminal: the table of all modules, what is found, and the keys."""

import contextlib
import os
import pty
import subprocess
import sys
from pathlib import Path

from tests.integration.test_attend import ROBOT, known_by_run


def test_a_known_robot_is_watched_in_the_table_of_its_modules_and_a_key_ends_it(
    launcher, programs, tmp_path: Path
) -> None:
    robot = launcher(ROBOT, physics="compiled")
    robot.start_world()
    robot.start_agents()
    folder = known_by_run(ROBOT, tmp_path / "known")
    command = [sys.executable, "-m", "coordinator.main", "monitor", str(folder)]
    here, there = pty.openpty()
    process = subprocess.Popen(
        [*command, "--listen", robot.config.endpoint],
        stdin=there,
        stdout=there,
        stderr=subprocess.PIPE,
        env={**os.environ, "COLUMNS": "200", "LINES": "60", "TERM": "xterm"},
    )
    os.close(there)
    os.set_blocking(here, False)
    shown = bytearray()

    def seen(*words: str) -> bool:
        # Nothing is shown yet, or the other end is closed.
        with contextlib.suppress(OSError):
            shown.extend(os.read(here, 1 << 20))
        return all(word.encode() in shown for word in words)

    try:
        # The table of the modules, that of the torques, and the keys.
        words = (f"2 of {len(robot.config.serials)} modules", "s monitored", "h hold, or release")
        programs.until(
            lambda: seen(*words, *robot.config.serials),
            "the tables",
        )
        os.write(here, b"l")
        programs.until(lambda: seen(f"the LED of {min(robot.config.serials)} is lit"), "a module's LED")
        os.write(here, b"q")
        programs.until(lambda: (seen(), process.poll() is not None)[1], "its end")
    finally:
        process.kill()
        _, notes = process.communicate()
        os.close(here)
    assert process.returncode in (0, 4), notes.decode()
    assert b"Traceback" not in notes
