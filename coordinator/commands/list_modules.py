"""`x5-coordinator list` and `stop`: the modules on the network, without a lease."""

from collections.abc import Mapping

from rich.table import Table

from coordinator.commands.options import ConnectOptions, Expect, JsonFile
from coordinator.live_robot.connection import Place, new_sender, open_connection
from coordinator.live_robot.discovery import AS_HUB_S, IS_IT_THERE, Listing, Search, listed, stop_robot
from coordinator.monitoring.module_states import full_name
from coordinator.runtime.command_line import with_options
from coordinator.runtime.terminal import Terminal, figure, new_table, print_table, write_result
from coordinator.synchronisation.feedback_delays import FeedbackDelay, feedback_delays
from module_agent.model.errors import RobotError
from module_agent.transport.transport import Transport
from module_agent.wire.messages import Status


@with_options
def list_modules(at: ConnectOptions, expect: Expect = None, json_file: JsonFile = None) -> None:
    """List the modules: names, state, holder, acting limits, delay of feedback, refused messages.

    Exit codes: 0 all answer, 1 a module does not answer or too few do, 2 wrong usage.
    """
    place = at.place()
    transport, search = _open_search(place, at.quiet, expect)
    found = listed(transport, place.robot, search)
    delays = {one.serial: one for one in feedback_delays(found.recording)}
    rows = [_fields(status, found, delays.get(status.serial)) for status in found.statuses]
    if write_result(json_file, rows) and rows:
        print_table(_table(place.robot, found, delays))
        if found.cpu_us_per_message is not None:
            Terminal(at.quiet).note(
                f"{found.cpu_us_per_message:.0f} us of CPU time for each message received here"
            )
    _check(place.robot, len(found.statuses), expect, "status", found.silent)


def _fields(status: Status, found: Listing, delay: FeedbackDelay | None) -> dict[str, object]:
    """Return what is known of a module, for programs; family, name and type as it tells them, or None.

    What a received message costs this program is of all modules together, and the same in each.
    """
    info = found.recording.modules[status.serial].info
    told = {name: getattr(info, name, None) for name in ("module_type", "family", "name")}
    cost_us = found.cpu_us_per_message
    return {
        **status.model_dump(),
        **told,
        "feedback_delay": delay and delay._asdict(),
        "cpu_us_per_message": cost_us,
    }


def _table(robot: str, found: Listing, delays: Mapping[str, FeedbackDelay]) -> Table:
    """Return the modules with the delay of their feedback from sample to here, and how well that is known."""
    table = new_table(
        robot,
        "serial | name | type | state | holder | >delay p50 [ms] | >p99 [ms] | >+- | expiries | limited by | "
        "refused",
    )
    for status in found.statuses:
        delay, info = delays.get(status.serial), found.recording.modules[status.serial].info
        table.add_row(
            status.serial,
            full_name(info) or "-",
            "-" if info is None else info.module_type,
            status.state,
            status.holder or "-",
            "-" if delay is None else delay.shown(delay.p50_ms),
            "-" if delay is None else delay.shown(delay.p99_ms),
            figure(delay and delay.clock_sigma_ms, ".1f"),
            str(status.expiries),
            ", ".join(status.limits) or "-",
            ", ".join(f"{k} {v}" for k, v in status.refusals.items()) or "-",
        )
    return table


@with_options
def stop(at: ConnectOptions, expect: Expect = None) -> None:
    """Stop every module of a robot at once, whichever program holds its lease.

    Exit codes: 0 all have confirmed, 1 a module has not or too few have, 2 wrong usage.
    """
    place = at.place()
    transport, search = _open_search(place, at.quiet, expect)
    stopped, silent = stop_robot(transport, place.robot, new_sender().name, search)
    Terminal(at.quiet).note(f"stopped: {', '.join(stopped) or 'none'}")
    _check(place.robot, len(stopped), expect, "confirmation", silent)


def _open_search(place: Place, quiet: bool, expect: int | None) -> tuple[Transport, Search]:
    """Join a robot's network to look for its modules; as its hub, wait for the agents to connect."""
    connection = open_connection(place, Terminal(quiet).note)
    return connection.transport, Search(min_s=AS_HUB_S if connection.is_hub else 0.0, expect=expect)


def _check(robot: str, answering: int, expect: int | None, answer: str, silent: list[str]) -> None:
    """Check which modules gave their answer, and how many."""
    if silent:
        raise RobotError(f"no {answer} from {', '.join(silent)}")
    if not answering:
        raise RobotError(f"no module of robot {robot!r} answers{IS_IT_THERE}")
    if expect is not None and answering < expect:
        raise RobotError(f"{answering} modules of robot {robot!r} answer, {expect} are expected")
