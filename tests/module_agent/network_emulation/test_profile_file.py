"""Network files and traces: what they say is what is replayed, and what is wrong is said with its place."""

import subprocess
from pathlib import Path

import pytest
from typer import Typer
from typer.testing import CliRunner

from coordinator.main import app as coordinator
from module_agent.main import app as agent
from module_agent.network_emulation import trace
from module_agent.network_emulation.profile import PROFILES, LossBurst, NetworkProfile, PathProfile, Stall
from module_agent.network_emulation.profile_file import (
    NetworkError,
    load_network,
    network,
    network_relative_to,
)
from module_agent.network_emulation.trace import NetworkTrace, TraceError, TraceRow, parse_trace
from sim.main import app as simulator
from sim.robot.robot_file import RobotFileError, load_robot, shipped_robots

GOOD = """
delay_ms = 1.0
jitter = "lognormal"
jitter_ms = 2.0
partitions = [[2.0, 2.5], [10.0, 12.0]]

[stall]
apart_s = 5.0
mean_ms = 30.0

[to_coordinator]
loss = 0.01
trace = "up.csv"
loss_burst = { apart_s = 1.0, mean_ms = 20.0 }
"""

TRACE = """time_s,delay_ms,lost
100.0,1.5,0
100.5,,1
100.75,2.5,0
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "up.csv").write_text(TRACE)
    (tmp_path / "shop.toml").write_text(GOOD)
    return tmp_path / "shop.toml"


def test_a_network_file_holds_a_profile_and_its_traces(file: Path) -> None:
    trace = NetworkTrace(
        rows=(TraceRow(0.0, 1.5, False), TraceRow(0.5, 0.0, True), TraceRow(0.75, 2.5, False))
    )
    assert network(str(file)) == NetworkProfile(
        name="shop",
        delay_ms=1.0,
        jitter="lognormal",
        jitter_ms=2.0,
        partitions=((2.0, 2.5), (10.0, 12.0)),
        stall=Stall(apart_s=5.0, mean_ms=30.0),
        to_coordinator=PathProfile(
            loss=0.01, trace=trace, loss_burst=LossBurst(apart_s=1.0, mean_ms=20.0, loss=1.0)
        ),
    )
    assert network(str(file)).path("module").trace is None


def test_a_name_is_a_profile_and_anything_else_a_file() -> None:
    assert {name: network(name) for name in PROFILES} == PROFILES
    with pytest.raises(
        NetworkError, match="unknown network profile 'pigeons', and no such file; known are none, "
    ):
        network("pigeons")


@pytest.mark.parametrize(
    ("old", "new", "line", "says"),
    [
        ("delay_ms = 1.0", "delay_ms = -1.0", 2, "delay_ms: expected at least 0, found -1.0"),
        ("delay_ms = 1.0", "delay_ms = ", 2, "not TOML"),
        ("delay_ms = 1.0", "latency_ms = 1.0", 2, "latency_ms: unknown key"),
        ('"lognormal"', '"normal"', 3, "jitter: expected 'gamma', 'lognormal' or 'pareto'"),
        ('"lognormal"', '"pareto"', 1, "that of a pareto jitter is less than 1"),
        ("[2.0, 2.5]", "[2.0, 1.5]", 1, "partitions: (2, 1.5)"),
        ("[2.0, 2.5]", "[2.0]", 5, "partitions[0][1]: is missing"),
        ("apart_s = 5.0\n", "", 7, "stall.apart_s: is missing"),
        ("loss = 0.01", "loss = 1.01", 12, "to_coordinator.loss: expected at most 1, found 1.01"),
        ("mean_ms = 20.0", "mean_ms = 0.0", 14, "to_coordinator.loss_burst.mean_ms: expected at least 0.1"),
        ('"up.csv"', "7", 13, "to_coordinator.trace: must be the name of a CSV file"),
        ('"up.csv"', '"down.csv"', 13, "to_coordinator.trace: "),
    ],
)
def test_a_wrong_file_is_refused_with_its_line_and_key(
    file: Path, old: str, new: str, line: int, says: str
) -> None:
    assert old in GOOD
    file.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(NetworkError) as refusal:
        load_network(file)
    messages = str(refusal.value).splitlines()
    assert any(m.startswith(f"{file}:{line}: ") and says in m for m in messages), messages


def test_a_file_that_cannot_be_read_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(NetworkError, match=r"binary\.toml: cannot be read"):
        network(str(tmp_path / "binary.toml"))


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ("", 1, "the first line must be time_s,delay_ms,lost"),
        ("time,delay,lost\n0,1,0\n", 1, "the first line must be time_s,delay_ms,lost"),
        ("time_s,delay_ms,lost\n\n", 1, "no rows"),
        ("time_s,delay_ms,lost\n0,1,0\n\n1,1\n", 4, "2 values, there must be 3"),
        ("time_s,delay_ms,lost\nnow,1,0\n", 2, "time_s: 'now' is not a number"),
        ("time_s,delay_ms,lost\n0,,0\n", 2, "delay_ms: '' is not a number"),
        ("time_s,delay_ms,lost\n0,-1,0\n", 2, "delay_ms: -1 must be from 0 to 10000"),
        ("time_s,delay_ms,lost\n0,1,0\n1,inf,0\n", 3, "delay_ms: inf is not finite"),
        ("time_s,delay_ms,lost\n0,1,maybe\n", 2, "lost: 'maybe' must be 0 or 1"),
        ("time_s,delay_ms,lost\n2,1,0\n1,1,0\n", 3, "time_s: 1 is before the row above"),
        ("time_s,delay_ms,lost\n2,1,0\n2,2,0\n", 3, "time_s: all rows have the same time"),
    ],
)
def test_a_wrong_trace_is_refused_with_its_line_and_column(text: str, line: int, says: str) -> None:
    with pytest.raises(TraceError) as refusal:
        parse_trace(text, "up.csv")
    assert str(refusal.value).startswith(f"up.csv:{line}: ")
    assert says in str(refusal.value)


def test_what_ping_prints_becomes_a_trace_by_the_documented_conversion(tmp_path: Path) -> None:
    assert trace.__doc__ is not None
    _, _, script = trace.__doc__.partition("with `ping_to_trace.awk`:\n")
    (tmp_path / "ping_to_trace.awk").write_text(script)
    said = """PING 10.1.1.7 (10.1.1.7) 56(84) bytes of data.
[1790000000.100000] 64 bytes from 10.1.1.7: icmp_seq=1 ttl=64 time=4.04 ms
[1790000000.125000] 64 bytes from 10.1.1.7: icmp_seq=2 ttl=64 time=1 ms
[1790000000.150000] no answer yet for icmp_seq=3
[1790000000.400000] 64 bytes from host.example (10.1.1.7): icmp_seq=4 ttl=64 time=250 ms

--- 10.1.1.7 ping statistics ---
4 packets transmitted, 3 received, 25% packet loss, time 300ms
rtt min/avg/max/mdev = 1.000/85.013/250.000/116.0 ms
"""
    done = subprocess.run(
        ["awk", "-f", str(tmp_path / "ping_to_trace.awk")],
        input=said,
        capture_output=True,
        text=True,
        check=True,
    )
    found = parse_trace(done.stdout, "ping.csv")
    assert [(round(r.time_s, 6), r.delay_ms, r.lost) for r in found.rows] == [
        (0.0, 2.02, False),
        (0.025, 0.5, False),
        (0.05, 0.0, True),
        (0.3, 125.0, False),
    ]


# --------------------------------------------------------------------------- named by programs and robots


@pytest.mark.parametrize(
    ("app", "arguments"),
    [
        (agent, ("--serial", "A-1", "--bus", "no-bus")),
        (coordinator, ("run", "--out", "no-run")),
        (simulator, ("run", shipped_robots()[0], "--out", "no-run")),
        (simulator, ("launch", shipped_robots()[0], "--out", "no-run")),
    ],
)
def test_every_program_refuses_a_wrong_network_file_with_its_line(file: Path, app: Typer, arguments) -> None:
    file.write_text(GOOD.replace("delay_ms = 1.0", "delay_ms = -1.0", 1))
    done = CliRunner().invoke(app, [*arguments, "--network", str(file)])
    assert done.exit_code == 2, done.output
    assert f"{file}:2: delay_ms: expected at least 0, found -1.0" in done.output


def robot_text(network_value: str) -> str:
    folder = Path(load_robot.__globals__["ROBOTS"])
    lines = (folder / f"{shipped_robots()[0]}.toml").read_text().splitlines()
    kept = [line for line in lines if not line.startswith("network")]
    place = next(i for i, line in enumerate(kept) if line.startswith("name"))
    return "\n".join([*kept[: place + 1], f'network = "{network_value}"', *kept[place + 1 :]])


def test_a_robots_file_names_its_network_from_its_own_folder(file: Path) -> None:
    robot = file.parent / "robot.toml"
    robot.write_text(robot_text("shop.toml"))
    found = load_robot(robot).network
    assert network(found) == load_network(file)
    robot.write_text(robot_text("lan"))
    assert load_robot(robot).network == "lan"
    robot.write_text(robot_text("other.toml"))
    with pytest.raises(RobotFileError, match=r"robot\.toml:\d+: network: .*other\.toml', and no such file"):
        load_robot(robot)


def test_a_network_file_is_found_relative_to_the_folder() -> None:
    assert network_relative_to("lan", Path("robots")) == "lan"
    assert network_relative_to("shop.toml", Path("robots")) == "robots/shop.toml"
    assert network_relative_to("/etc/shop.toml", Path("robots")) == "/etc/shop.toml"
