"""Every file and option of the three programs, given something else: a sentence, a code, nothing made."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from coordinator.attendant.workspace import load_workspace
from coordinator.excitation.plan import load_plan
from coordinator.live_robot.discovery import IS_IT_THERE
from coordinator.main import app as coordinator
from module_agent.control.safety_file import read_safety
from module_agent.main import app as agent
from module_agent.model.errors import UsageError
from module_agent.model.settings import read_settings
from module_agent.network_emulation.profile_file import load_network
from module_agent.transport.credentials import load_fleet
from sim.main import app as sim
from sim.robot.robot_file import load_robot
from sim.virtual_time.run import QUICK_PLAN, VirtualConfig, run_virtual
from sim.world.external_force import parse_push

PROGRAMS = {"x5-coordinator": coordinator, "x5-sim": sim, "x5-agent": agent}
ROBOT = "thesis_171_horizontal"
# What is given in the place of a file or a folder; None is not there at all.
CONTENTS: dict[str, bytes | None] = {
    "missing": None,
    "folder": b"",
    "empty": b"",
    "binary": bytes(range(256)) * 20,
    "words": b"carrier pigeons\n",
    "list.json": b"[1, 2, 3]",
    "types.json": b'{"serials": 3, "chain": [], "robot": {"a": null}, "schema": "two"}',
    "deep.json": b"[" * 20_000,
    "types.toml": b'name = 3\nmodules = "many"\nrate_hz = -1\n',
    "huge.toml": b"delay_s = 1e999\nseed = 99999999999999999999999999\nloss = nan\n",
    "deep.toml": b"a = " + b"[" * 20_000,
    "dotted.toml": b".".join([b"a"] * 100) + b" = 1\n",
    "digits.toml": b"seed = 1" + b"0" * 5_000,
    "hexadecimal.toml": b"seed = 0x1" + b"0" * 5_000,
    "deep.xml": b"<a>" * 20_000,
    "numbers.csv": b"t,q,tau\n0,nan,1\n-1,inf,x\n",
    "robot.xml": b'<robot name="r"><link name="a"/><joint name="j" type="flying"/></robot>',
}
# Commands by program; BAD is the file or the folder, NEW a place for what is written.
COMMANDS: dict[str, tuple[str, ...]] = {
    "x5-coordinator": (
        "replay BAD --out NEW",
        "report BAD --out NEW",
        "screenshot BAD --out NEW",
        "check BAD --out NEW",
        "check BAD --measured BAD",
        "payload BAD --out NEW",
        "merge BAD BAD --out NEW",
        "monitor BAD",
        "excite --urdf BAD --out NEW",
        "fit-dynamics --urdf BAD --data BAD",
        "compensate BAD",
        "follow BAD --motion BAD --out NEW",
        "run --out NEW --baseline BAD",
        "run --out NEW --measured BAD",
        "run --out NEW --plan BAD",
        "run --out NEW --network BAD",
        "run --out NEW --secure BAD",
        "list --secure BAD",
        "stop --network BAD",
        "safety BAD A",
        "safety BAD A --out NEW",
        "export BAD --to csv --out NEW",
        "view BAD",
        "import BAD --type X5-4 --out NEW",
        "gains load BAD",
        "identify A --network BAD",
        "check-link --network BAD",
        "attend BAD",
        "attend . --may-move --workspace BAD",
    ),
    "x5-sim": (
        "run BAD --virtual --out NEW",
        "launch BAD --out NEW",
        "world BAD --bus NEW",
        "show BAD",
        "score BAD",
        "compare-log BAD",
        f"run {ROBOT} --virtual --out NEW --plan BAD",
        f"run {ROBOT} --virtual --out NEW --network BAD",
        f"run {ROBOT} --virtual --out NEW --noise BAD",
        f"run {ROBOT} --virtual --out NEW --safety BAD",
        "watch --robot BAD --out NEW",
        "faults --seeds 1..1 --robot BAD",
        "faults --seeds 1..1 --network BAD",
        "faults --seeds 1..1 --fault BAD",
    ),
    "x5-agent": (
        "--serial A --bus NEW --network BAD",
        "--serial A --bus NEW --secure BAD",
        "--serial A --bus NEW --safety BAD",
    ),
}
# Options that are nonsense; the files are not read.
OPTIONS: dict[str, tuple[str, ...]] = {
    "x5-coordinator": (
        *(f"run --out NEW --speed {value}" for value in ("0", "-1", "nan", "inf", "fast")),
        *(f"run --out NEW --expect {value}" for value in ("0", "-3", "1.5", "all")),
        *(f"run --out NEW --seed {value}" for value in ("-1", "x", "0.5")),
        *(f"run --out NEW --serve-port {value}" for value in ("0", "70000", "port")),
        *(f"run --out NEW --{name} pigeons" for name in ("imu", "torque", "mode", "motions", "viewer")),
        *(f"run --out NEW --amplitude {value}" for value in ("-1", "nan", "1e9", "x")),
        *(f"run --out NEW --listen {value}" for value in ("x", "tcp/", "tcp/a", "tcp/127.0.0.1:99999")),
        *(f"{name} --robot {value}" for name in ("list", "stop") for value in ("a/b", "*", "**")),
        *(f"keys A --out NEW --days {value}" for value in ("-1", "0", "x", "1e9")),
        "keys A/B --out NEW",
        "keys A A/* --out NEW",
        *(
            f"attend BAD --{name} {value}"
            for name in ("for", "alarms-per-hour")
            for value in ("-1", "nan", "x")
        ),
        *(f"{name} --for {value}" for name in ("identify A", "check-link") for value in ("-1", "nan", "x")),
        *(f"check-link --expect {value}" for value in ("0", "-3", "x")),
        "gains load",
        "identify",
        "import",
        "run",
        "replay",
        "merge",
        "levitate",
        "run --out NEW --levitate",
        "run --out NEW extra",
    ),
    "x5-sim": (
        *(f"run {ROBOT} --virtual --out NEW --seed {value}" for value in ("-1", "x", "nan")),
        *(f"run {ROBOT} --virtual --out NEW --speed {value}" for value in ("0", "-1", "nan", "inf")),
        *(f"run {ROBOT} --virtual --out NEW --imu-rate-hz {value}" for value in ("0", "-5", "nan", "x")),
        *(f"run {ROBOT} --virtual --out NEW --push {value}" for value in ("x", "1,2", "nan,nan,nan,nan")),
        *(f"run {ROBOT} --virtual --out NEW --{name} pigeons" for name in ("physics", "with", "without")),
        *(f"run {ROBOT} --out NEW --processes {value}" for value in ("0", "-1", "x")),
        *(f"fleet --{name} {value}" for name in ("robots", "modules", "seconds") for value in ("-1", "x")),
        *(f"faults --seeds {value}" for value in ("x", "5..1", "-3..-1", "1..", "")),
        *(f"benchmark kinematics --trials {value}" for value in ("0", "-1", "x")),
        *(f"monitoring --hours {value}" for value in ("-1", "x")),
        *(
            f"watch --out NEW --{name} {value}"
            for name in ("hours", "trials")
            for value in ("-1", "nan", "x")
        ),
        *(f"watch --out NEW --{name} pigeons" for name in ("kind", "robot", "noise")),
        *(f"faults --seeds 1..1 --{name} pigeons" for name in ("fault", "robot", "network")),
        f"faults --seeds 1..1 --robot {ROBOT} --modules 1",
        "thesis --only figure9999",
        "benchmark kinematics --only pigeons",
        "compare-log",
        "run",
        "levitate",
    ),
    "x5-agent": (
        *(f"--serial A --bus NEW --feedback-rate {value}" for value in ("0", "-1", "nan", "5000", "x")),
        *(f"--serial A --bus NEW --lifetime-ms {value}" for value in ("0", "-1", "nan", "5000", "x")),
        *(f"--serial A --bus NEW --strategy {value}" for value in ("-1", "9", "x")),
        *(f"--serial A --bus NEW --{name} pigeons" for name in ("imu", "expiry", "network", "connect")),
        "--serial A --bus NEW --robot a/b",
        "--serial a/b --bus NEW",
        "--bus NEW",
        "--serial A",
    ),
}
WITH_FILES = [
    (program, command, content)
    for program, commands in COMMANDS.items()
    for command in commands
    for content in CONTENTS
]


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str, Path], str]:
    """Runs a command that must not work, and returns what it says."""
    monkeypatch.chdir(tmp_path)

    def run(program: str, command: str, bad: Path) -> str:
        before = sorted(os.walk(tmp_path))
        new = tmp_path / "new"
        words = [{"BAD": str(bad), "NEW": str(new)}.get(word, word) for word in command.split(" ")]
        done = CliRunner().invoke(PROGRAMS[program], words)
        said = done.stderr.strip()
        where = f"{program} {command}: {said or done.stdout}"
        assert done.exception is None or isinstance(done.exception, SystemExit), where
        assert done.exit_code in (1, 2, 3), where
        assert said, where
        for word in ("Traceback", "pydantic", "KeyError", "validation error", "errors.py", "NoneType"):
            assert word not in said, where
        # A file is read before anybody is looked for.
        assert IS_IT_THERE not in said, where
        # The parser's own errors begin with how to use the command.
        assert said.startswith("Usage:") or f"{program}: " in said, where
        assert sorted(os.walk(tmp_path)) == before, where
        return said

    return run


def test_there_are_at_least_200_bad_inputs() -> None:
    assert len(WITH_FILES) + sum(map(len, OPTIONS.values())) >= 400


@pytest.mark.parametrize(("program", "command"), [(p, c) for p in COMMANDS for c in COMMANDS[p]])
def test_what_is_no_such_file_is_refused(
    refused: Callable[[str, str, Path], str], tmp_path: Path, program: str, command: str
) -> None:
    failures = []
    for name, content in CONTENTS.items():
        bad = tmp_path / name
        if name == "folder":
            bad.mkdir()
        elif content is not None:
            bad.write_bytes(content)
        try:
            refused(program, command, bad)
        except AssertionError as failure:
            failures.append(f"{name}: {failure}")
    assert not failures, "\n".join(failures)


@pytest.mark.parametrize(("program", "command"), [(p, c) for p in OPTIONS for c in OPTIONS[p]])
def test_nonsense_is_refused(
    refused: Callable[[str, str, Path], str], tmp_path: Path, program: str, command: str
) -> None:
    refused(program, command, tmp_path / "missing")


# --------------------------------------------------------------------------- runs with one damaged file

# What reads a file of a run, whose folder is RUN, by that file.
READ_BY: dict[str, tuple[str, ...]] = {
    "session.mcap": (
        "replay RUN --out NEW",
        "report RUN --out NEW.md",
        "export RUN --to csv --out NEW",
        "check RUN --out NEW",
        "check RUN --measured RUN",
        "payload RUN --out NEW",
        "monitor RUN",
        "attend RUN",
        "run --out NEW --baseline RUN",
    ),
    "session.rrd": ("view RUN", "screenshot RUN --out NEW.png"),
    "result.json": (
        "report RUN --out NEW.md",
        "payload RUN --out NEW",
        "attend RUN",
        "compensate RUN",
        "follow RUN --motion RUN/motion.csv --out NEW",
    ),
    "robot.urdf": (
        "export RUN --to csv --out NEW",
        "export RUN --to ros2 --out NEW",
        "excite --urdf RUN/robot.urdf --out NEW",
        "fit-dynamics --urdf RUN/robot.urdf --data RUN/motion.csv",
    ),
    "held_out.npz": ("report RUN --out NEW.md",),
    "information.npz": ("merge RUN RUN --out NEW",),
    "imu_calibration.npz": (
        "merge RUN RUN --out NEW",
        "run --out NEW --measured RUN",
    ),
}
READ_BY_SIM = {
    "result.json": ("score RUN",),
    "held_out.npz": ("score RUN",),
    "truth.json": ("score RUN",),
    "truth.npz": ("score RUN",),
    "robot.hrdf": ("run RUN/robot.hrdf --virtual --out NEW",),
}
OF_RUNS = [
    (program, name, command)
    for program, table in (("x5-coordinator", READ_BY), ("x5-sim", READ_BY_SIM))
    for name, commands in table.items()
    for command in commands
]
DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "cut": lambda content: content[: len(content) // 4],
    "binary": lambda content: bytes(range(256)) * 20,
    "empty": lambda content: b"",
    "list": lambda content: b"[1, 2, 3]",
    # The archive is whole, and what is packed in it is not.
    "bytes": lambda content: content[:300] + bytes(40) + content[340:],
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run on an arm of two modules, dynamics included."""
    out = tmp_path_factory.mktemp("finished") / "run"
    plan = QUICK_PLAN.model_copy(update={"dynamics": True, "dynamic_repeats": 1})
    run_virtual(VirtualConfig(load_robot(ROBOT), out, seed=3, plan=plan))
    (out / "motion.csv").write_text("t_s,q_X-00009_rad\n0,0\n1,0\n")
    return out


@pytest.mark.xdist_group("damaged runs")
@pytest.mark.parametrize(("program", "name", "command"), OF_RUNS)
def test_a_run_with_one_damaged_file_is_refused_or_the_damage_is_said(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, name: str, command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    failures = []
    for kind, damaged in DAMAGE.items():
        # Of a view that is cut the viewer shows what there is.
        if (kind, name) == ("cut", "session.rrd") or (kind == "bytes" and not name.endswith("npz")):
            continue
        run, new = tmp_path / kind / "run", tmp_path / kind / "new"
        shutil.copytree(finished, run, copy_function=os.link)
        content = (run / name).read_bytes()
        (run / name).unlink()
        (run / name).write_bytes(damaged(content))
        words = command.replace("RUN", str(run)).replace("NEW", str(new)).split(" ")
        done = CliRunner().invoke(PROGRAMS[program], words)
        said = done.stderr + done.stdout
        private = [word for word in ("Traceback", "pydantic", "NoneType") if word in said]
        is_ours = done.exception is None or isinstance(done.exception, SystemExit)
        # What is left of a recording may be whole, and end early.
        is_said = name in said or (name == "session.mcap" and "recording ends" in said)
        if not is_ours or private or not is_said or done.exit_code not in (0, 1, 2, 3, 5):
            failures.append(f"{kind}: {done.exit_code} {done.exception!r} {said}")
    assert not failures, "\n".join(failures)


# TOML that the parser of Python cannot read, or that no setting can be: what is said of it.
NO_TOML = {
    "deep.toml": ":1: nested deeper than 16 levels",
    "dotted.toml": ":1: a.a.",
    "lines.toml": ":3: nested deeper than 16 levels",
    "digits.toml": ":2: an integer of more than 64 bits",
    "hexadecimal.toml": ":2: seed: an integer of more than 64 bits",
}
TOML_CONTENTS = {
    **{name: CONTENTS[name] for name in ("deep.toml", "dotted.toml")},
    "lines.toml": b"robot = 'arm'\n\na = [\n" + b"[\n" * 20_000,
    **{name: b"robot = 'arm'\n" + (CONTENTS[name] or b"") for name in ("digits.toml", "hexadecimal.toml")},
}
READERS: dict[str, Callable[[Path], object]] = {
    "settings": lambda path: read_settings({"X5_SETTINGS": str(path)}, path.parent),
    "settings of the folder": lambda path: read_settings({}, path.rename(path.parent / "x5.toml").parent),
    "plan": load_plan,
    "workspace": load_workspace,
    "network": load_network,
    "fleet": lambda path: load_fleet(path.rename(path.parent / "fleet.toml").parent),
    "safety": lambda path: read_safety(path, ["A"]),
    "robot": load_robot,
    "push": lambda path: parse_push(path.read_text().splitlines()[-1]),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("name", NO_TOML)
def test_toml_that_cannot_be_read_is_refused_with_its_line(tmp_path: Path, reader: str, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(TOML_CONTENTS[name])
    with pytest.raises(UsageError) as refused:
        READERS[reader](path)
    said = str(refused.value)
    if reader == "push":
        # An option, not a file: it is one line.
        assert said.count(" is no push:1:") == 1
    else:
        assert NO_TOML[name] in said
        assert str(tmp_path) in said
