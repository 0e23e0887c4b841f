"""A fleet as processes: routers, worlds, agents and coordinators, started in order, measured, and stopped."""

import json
import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from sim.processes.fleet_figures import (
    FleetFigures,
    Reading,
    missed,
    near_limits,
    of_kind,
    percentiles_ms,
    read_limits,
    read_process,
)
from sim.processes.fleet_member import READY, START_TIMEOUT_S, Heard
from sim.processes.fleet_plan import FleetPlan, PlannedRobot, robot_file
from sim.processes.launcher import (
    LOGS,
    Child,
    LaunchConfig,
    Launcher,
    LaunchError,
    last_output,
    start_child,
    stop_child,
    whole_log,
)

_POLL_S = 0.2
_MEMBER = "sim.processes.fleet_member"
TICKS_PER_S = 1000.0
# How long coordinators may need beyond the stated time: their last round of requests.
_GRACE_S = 60.0


class FleetConfig(NamedTuple):
    """How long and how fast a fleet runs, whether its robots move, and the folder of its logs.

    With `truth` every world writes the true motion there; it takes 0.4 MB a second for 64 modules until then.
    """

    plan: FleetPlan
    out: Path
    seconds: float
    speed: float = 1.0
    seed: int = 0
    moves: bool = False
    truth: bool = False


def run_fleet(config: FleetConfig, report: Callable[[str], None]) -> FleetFigures:
    """Start everything, measure for the stated time, stop everything; also when interrupted.

    Raises:
        LaunchError: a process did not start, or ended early.
    """
    logs = config.out / LOGS
    logs.mkdir(parents=True, exist_ok=True)
    begin = config.out / "begin"
    begin.unlink(missing_ok=True)
    children: dict[str, list[Child]] = {"router": [], "world": [], "agent": [], "coordinator": []}
    with ExitStack() as opened:

        def start(kind: str, name: str, *arguments: str) -> None:
            child = start_child(name, (_MEMBER, kind, *arguments), logs / f"{name}.log", up=READY)
            opened.callback(stop_child, child)
            children[kind].append(child)

        for router in config.plan.routers:
            start("router", router.name, router.endpoint, *([router.parent] if router.parent else []))
            _wait_until_up(children["router"])
        report(f"{len(config.plan.routers)} routers are up")
        for number, robot in enumerate(config.plan.robots):
            launcher = opened.enter_context(Launcher(_launch(config, robot, number), lambda text: None))
            children["world"].append(launcher.start_world())
            children["agent"] += launcher.start_agents()
            counted, where = str(len(robot.serials)), f"coordinator-{robot.name}"
            what = (robot.name, config.plan.root, counted, str(config.seconds), str(begin))
            start("coordinator", where, *what, *(("move",) if config.moves else ()))
            report(f"{robot.name}: {counted} modules in {robot.processes} processes started")
        _wait_until_up([*children["agent"], *children["coordinator"]])
        report(f"all {config.plan.module_count} modules answer; measuring for {config.seconds:g} s")
        begin.touch()
        return _measure(config, children, report)


def _launch(config: FleetConfig, robot: PlannedRobot, number: int) -> LaunchConfig:
    folder = config.out / robot.name
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{robot.name}.toml"
    path.write_text(robot_file(robot))
    return LaunchConfig(
        robot_file=str(path),
        robot_name=robot.name,
        serials=robot.serials,
        out=folder,
        seed=config.seed + number,
        network="none",
        speed=config.speed,
        endpoint=robot.router,
        processes=robot.processes,
        # Chains that hang from a ceiling touch nothing: the engine that costs less does.
        physics="compiled",
        truth=config.truth,
    )


def _wait_until_up(children: list[Child]) -> None:
    end_s = time.monotonic() + START_TIMEOUT_S
    while late := [child for child in children if child.up not in whole_log(child)]:
        _check_alive(late)
        if time.monotonic() > end_s:
            raise LaunchError(f"{late[0].name} is not up within {START_TIMEOUT_S:.0f} s")
        time.sleep(_POLL_S)


def _check_alive(children: list[Child]) -> None:
    for child in children:
        if child.process.poll() is not None:
            raise LaunchError(
                f"{child.name} ended with {child.process.returncode}: {last_output(child) or 'no output'}"
            )


def _measure(
    config: FleetConfig, children: dict[str, list[Child]], report: Callable[[str], None]
) -> FleetFigures:
    before, start_s = _read(children), time.monotonic()
    limits, reached = read_limits(), dict[str, str]()
    served = [child for kind in ("router", "world", "agent") for child in children[kind]]
    after, spent_s = before, 0.0
    while (left_s := start_s + config.seconds - time.monotonic()) > 0.0:
        time.sleep(min(1.0, left_s))
        is_last = left_s <= 1.0
        _check_alive(served if is_last else [*served, *children["coordinator"]])
        try:
            after, spent_s = _read(children), time.monotonic() - start_s
        except LaunchError:
            # In the last second coordinators end in order: then the reading of a second before counts.
            if not is_last or not spent_s:
                raise
            _check_alive(served)
        for what, text in near_limits([one for each in after.values() for one in each], limits).items():
            reached.setdefault(what, f"{text} after {spent_s:.0f} s")
    report("collecting what the coordinators measured")
    heard = [_heard(child) for child in children["coordinator"]]
    real_time, lost = min(each.real_time for each in heard), sum(each.rows_lost for each in heard)
    unanswered = sum(each.unanswered for each in heard)
    failed = sum(each.motions_failed for each in heard)
    broke = [*reached.values(), *missed(real_time, config.speed, lost, unanswered, failed)]
    p50, p99 = percentiles_ms([trip for each in heard for trip in each.round_trips_ms])
    kinds = {kind: of_kind(before[kind], after[kind], spent_s) for kind in children}
    cpu_us_per_s = 1e4 * sum(each.cpu_percent for each in kinds.values())
    ticks_per_s = TICKS_PER_S * sum(
        each.real_time * len(robot.serials) for each, robot in zip(heard, config.plan.robots, strict=True)
    )
    return FleetFigures(
        robots=len(config.plan.robots),
        modules=len(config.plan.robots[0].serials),
        routers=len(config.plan.routers),
        seconds=config.seconds,
        asked_speed=config.speed,
        real_time=real_time,
        rows_per_s=sum(each.rows / each.seconds for each in heard),
        rows_lost=lost,
        unanswered=unanswered,
        round_trip_p50_ms=p50,
        round_trip_p99_ms=p99,
        us_per_module_tick=cpu_us_per_s / ticks_per_s if ticks_per_s else float("nan"),
        kinds=kinds,
        broke=tuple(broke),
        motions=sum(each.motions for each in heard),
        motions_failed=failed,
    )


def _read(children: dict[str, list[Child]]) -> dict[str, list[Reading]]:
    """Read all processes.

    Raises:
        LaunchError: one has ended.
    """
    ticks_per_s = os.sysconf("SC_CLK_TCK")
    readings: dict[str, list[Reading]] = {kind: [] for kind in children}
    for kind, each in children.items():
        for child in each:
            try:
                readings[kind].append(read_process(child.process.pid, ticks_per_s))
            except OSError as error:
                raise LaunchError(f"{child.name} ended while it was measured") from error
    return readings


def _heard(coordinator: Child) -> Heard:
    end_s = time.monotonic() + _GRACE_S
    while not (lines := [line for line in whole_log(coordinator).splitlines() if line.startswith("{")]):
        if coordinator.process.poll() is not None or time.monotonic() > end_s:
            raise LaunchError(f"{coordinator.name} measured nothing: {last_output(coordinator)}")
        time.sleep(_POLL_S)
    return Heard(**json.loads(lines[-1]))
