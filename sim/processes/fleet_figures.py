"""What a fleet costs and what it delivers: readings of processes, the summary, and what broke first."""

import resource
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

# A robot that lags more has lost real time; a fifth of a percent is the clocks' own difference.
HELD_REAL_TIME = 0.98
# Of what the machine allows: beyond it the next process may not start.
SHARE = 0.8


class Reading(NamedTuple):
    """A process: its CPU time so far [s], memory, threads, and open sockets."""

    cpu_s: float
    rss_mib: float
    threads: int
    sockets: int


class KindFigures(NamedTuple):
    """All processes of a kind: how many, CPU [% of a core], memory [MiB], threads, sockets, as sums.

    grown_mib: by how much their memory grew while they were measured.
    """

    processes: int
    cpu_percent: float
    rss_mib: float
    threads: int
    sockets: int
    grown_mib: float = 0.0


class Limits(NamedTuple):
    """What the machine allows: open files of a process, memory [MiB] and threads of all together."""

    open_files: float
    memory_mib: float
    threads: float


class FleetFigures(NamedTuple):
    """What a fleet measured, `kinds` by the kind of process.

    broke: what did not hold. First what came near a limit of the machine, in order of time, then what the
    coordinators missed over the whole time.

    round_trip_ms: a status request and its answer, 50 and 99 %. real_time: of the slowest robot.
    us_per_module_tick: CPU of all processes over ticks of all modules [us]. motions: of robots that move, one
    joint each at a time, that came to their end, and that did not.
    """

    robots: int
    modules: int
    routers: int
    seconds: float
    asked_speed: float
    real_time: float
    rows_per_s: float
    rows_lost: int
    unanswered: int
    round_trip_p50_ms: float
    round_trip_p99_ms: float
    us_per_module_tick: float
    kinds: dict[str, KindFigures]
    broke: tuple[str, ...]
    motions: int = 0
    motions_failed: int = 0


def read_process(pid: int, ticks_per_s: int) -> Reading:
    """Read a living process from /proc.

    Raises:
        OSError: it has ended.
    """
    folder = Path(f"/proc/{pid}")
    # The name of the program, in brackets, may hold blanks.
    fields = (folder / "stat").read_text().rsplit(")", 1)[1].split()
    targets = [_target(path) for path in (folder / "fd").iterdir()]
    sockets = sum(target.startswith("socket:") for target in targets)
    cpu_s = (int(fields[11]) + int(fields[12])) / ticks_per_s
    status = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
    if "VmRSS" not in status:
        # Its parent has not taken note of its end yet.
        raise ProcessLookupError(f"process {pid} has ended")
    return Reading(cpu_s, int(status["VmRSS"].split()[0]) / 1024.0, int(fields[17]), sockets)


def _target(path: Path) -> str:
    try:
        return str(path.readlink())
    except OSError:
        return ""


def of_kind(before: list[Reading], after: list[Reading], seconds: float) -> KindFigures:
    """Return the sums over the processes of one kind."""
    cpu_s = sum(b.cpu_s - a.cpu_s for a, b in zip(before, after, strict=True))
    return KindFigures(
        len(after),
        100.0 * cpu_s / seconds,
        sum(reading.rss_mib for reading in after),
        sum(reading.threads for reading in after),
        sum(reading.sockets for reading in after),
        sum(b.rss_mib - a.rss_mib for a, b in zip(before, after, strict=True)),
    )


def read_limits() -> Limits:
    """Read the limits of this process, of the machine, and of the control group that it shows, if any."""
    total_kib = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())[
        "MemTotal"
    ]
    groups = Path("/sys/fs/cgroup")
    return Limits(
        _lowest([resource.getrlimit(resource.RLIMIT_NOFILE)[0]]),
        min(
            int(total_kib.split()[0]) / 1024.0,
            _lowest([groups / "memory.max", groups / "memory/memory.limit_in_bytes"]) / 2**20,
        ),
        _lowest(
            [
                resource.getrlimit(resource.RLIMIT_NPROC)[0],
                *(groups / "pids.max", groups / "pids/pids.max", Path("/proc/sys/kernel/threads-max")),
            ]
        ),
    )


def _lowest(limits: Iterable[int | Path]) -> float:
    """Return the lowest limit; infinite where there is none: -1, "max", or no file of it."""
    found = [float("inf")]
    for limit in limits:
        if isinstance(limit, Path):
            text = limit.read_text().strip() if limit.is_file() else "max"
            found.append(float(text) if text != "max" else float("inf"))
        elif limit >= 0:
            found.append(float(limit))
    return min(found)


def near_limits(readings: list[Reading], limits: Limits) -> dict[str, str]:
    """Return in words what has come near a limit, by what it is."""
    most = max(reading.sockets for reading in readings)
    memory_mib, threads = sum(r.rss_mib for r in readings), sum(r.threads for r in readings)
    near = {}
    if most > SHARE * limits.open_files:
        near["sockets"] = f"sockets: {most} of {limits.open_files:.0f} open files in one process"
    if memory_mib > SHARE * limits.memory_mib:
        near["memory"] = f"memory: {memory_mib:.0f} of {limits.memory_mib:.0f} MiB"
    if threads > SHARE * limits.threads:
        near["threads"] = f"threads: {threads} of {limits.threads:.0f}"
    return near


def missed(
    real_time: float, asked: float, rows_lost: int, unanswered: int, motions_failed: int = 0
) -> list[str]:
    """Return in words what did not hold."""
    faults = []
    if real_time < HELD_REAL_TIME * asked:
        faults.append(f"CPU: {real_time:.2f} times real time where {asked:g} were asked for")
    if rows_lost:
        faults.append(f"network: {rows_lost} rows lost")
    if unanswered:
        faults.append(f"network: {unanswered} requests unanswered")
    if motions_failed:
        faults.append(f"motions: {motions_failed} did not come to their end")
    return faults


def percentiles_ms(trips_ms: list[float]) -> tuple[float, float]:
    """Return the 50th and 99th percentile, not a number without any."""
    if not trips_ms:
        return float("nan"), float("nan")
    p50, p99 = np.percentile(trips_ms, (50.0, 99.0))
    return float(p50), float(p99)


def table_rows(figures: FleetFigures) -> list[tuple[str, ...]]:
    """Return one row for each kind of process and one for all: as the columns of the printed table."""
    kinds = {**figures.kinds, "all": KindFigures(*map(sum, zip(*figures.kinds.values(), strict=True)))}
    return [
        (
            kind,
            str(each.processes),
            f"{each.cpu_percent:.0f}",
            f"{each.rss_mib:.0f}",
            f"{each.grown_mib:.1f}",
            str(each.threads),
            str(each.sockets),
        )
        for kind, each in kinds.items()
    ]


def summary(figures: FleetFigures) -> str:
    """Return what the fleet delivered, in lines."""
    return "\n".join(
        (
            f"{figures.robots * figures.modules} modules ({figures.robots} robots of {figures.modules}), "
            f"{figures.routers} routers, {figures.seconds:.0f} s",
            f"real time: {figures.real_time:.2f} of {figures.asked_speed:g} asked for",
            f"rows: {figures.rows_per_s:.0f} a second, {figures.rows_lost} lost",
            f"request and answer: 50 % within {figures.round_trip_p50_ms:.1f} ms, 99 % within "
            f"{figures.round_trip_p99_ms:.1f} ms, {figures.unanswered} unanswered",
            f"CPU: {figures.us_per_module_tick:.0f} us for each module and tick",
            *([f"motions: {figures.motions} done, {figures.motions_failed} not"] if figures.motions else []),
            f"broke first: {figures.broke[0] if figures.broke else 'nothing'}",
        )
    )
