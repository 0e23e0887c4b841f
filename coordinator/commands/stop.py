"""`x5-coordinator stop`: every module stops, without a lease."""

from coordinator.commands.list_modules import check_count, open_search
from coordinator.commands.options import ConnectOptions, Expect
from coordinator.live_robot.connection import sender_name
from coordinator.live_robot.discovery import stop_robot
from coordinator.runtime.command_line import with_options
from coordinator.runtime.terminal import Terminal
from module_agent.model.errors import RobotError


@with_options
def stop(at: ConnectOptions, expect: Expect = None) -> None:
    """Stop every module of a robot at once, whichever program holds its lease.

    Exit codes: 0 all have confirmed, 1 a module has not or too few have, 2 wrong usage.
    """
    place = at.place()
    transport, search = open_search(place, at.quiet, expect)
    stopped, silent = stop_robot(transport, place.robot, sender_name(), search)
    Terminal(at.quiet).note(f"stopped: {', '.join(stopped) or 'none'}")
    if silent:
        raise RobotError(f"no confirmation from {', '.join(silent)}")
    check_count(place.robot, len(stopped), expect)
