"""`x5-coordinator fit-dynamics`: what recorded torques say of the dynamics of anybody's robot."""

from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Annotated

import typer

from coordinator.arm_fit.data_file import DataFileError, JointLog, in_two, read_log
from coordinator.arm_fit.filtered_log import filtered_log, most_samples, usual_cutoff_hz
from coordinator.arm_fit.fit import STEPS, Elsewhere, Identified, identified
from coordinator.arm_fit.physically_consistent import USUAL_TRUST
from coordinator.arm_fit.problem import ModelChoice, Problem, problem
from coordinator.arm_fit.report import write_report
from coordinator.commands.fit_dynamics_tables import notes, tables
from coordinator.commands.options import Quiet
from coordinator.description.urdf_reader import STANDARD_GRAVITY, UrdfError, UrdfRobot, read_urdf
from coordinator.description.urdf_update import friction_of, write_fitted_urdf
from coordinator.dynamics.drive_model import USUAL_TERMS
from coordinator.runtime.command_line import fail
from coordinator.runtime.terminal import Terminal, print_table
from module_agent.model.errors import EXIT_FAILED, EXIT_USAGE, RobotError
from module_agent.signals.torque_terms import DRIVE_TERMS, Term

_UP = ",".join(f"{part:g}" for part in STANDARD_GRAVITY)
_USUAL_TERMS = ",".join(USUAL_TERMS)
_USUAL = ModelChoice()


_Urdf = Annotated[Path, typer.Option(help="URDF file: revolute, continuous and fixed joints.")]
_Data = Annotated[
    Path,
    typer.Option(
        help="CSV with t_s, q_JOINT_rad, tau_JOINT_nm and, if measured, qd_JOINT_rad_s; or npz with "
        "position_rad, torque, sample_rate_hz or t_s, and perhaps velocity_rad_s and joint_names."
    ),
]
_HeldOut = Annotated[
    Path | None,
    typer.Option(
        help="Another recording of the robot, CSV or npz, to try on what is fitted to the whole of --data."
    ),
]
_Json = Annotated[Path | None, typer.Option("--json", help="JSON file to write the report to.")]
_FittedUrdf = Annotated[
    Path | None,
    typer.Option(help="File to write the URDF to with the real bodies and friction that were found."),
]
_Trust = Annotated[float, typer.Option(help="How much the URDF's own inertias count for the real bodies.")]
_Terms = Annotated[str, typer.Option(help=f"Terms of the drives, of {', '.join(DRIVE_TERMS)}; or none.")]
_Coupled = Annotated[
    list[str] | None,
    typer.Option(help="Two joints that share a drive, by number or name: 5,6. Repeat for several."),
]
_Robust = Annotated[bool, typer.Option("--robust", help="Huber's weights: outliers count little.")]
_Instruments = Annotated[
    bool,
    typer.Option(
        "--instruments",
        help="Instrumental variables: every other sample judges the rest, so that the noise of encoders "
        "does not make inertias too small. Uses half of the samples.",
    ),
]
_Cutoff = Annotated[
    float | None, typer.Option(help="Low-pass over motion and torque [Hz]; by the motion if not given.")
]
_Gravity = Annotated[
    str, typer.Option(help="Specific force of rest in the root link's frame [m/s^2]: upwards, 9.81 long.")
]
_Mask = Annotated[float, typer.Option(help="Part of a joint's top speed below which samples are masked.")]
_Slow = Annotated[float, typer.Option(help="Part of a joint's top speed below which Coulomb friction fades.")]


def fit_dynamics(
    urdf: _Urdf,
    data: _Data,
    held_out: _HeldOut = None,
    json_file: _Json = None,
    fitted_urdf: _FittedUrdf = None,
    trust: _Trust = USUAL_TRUST,
    terms: _Terms = _USUAL_TERMS,
    coupled: _Coupled = None,
    robust: _Robust = False,
    instruments: _Instruments = False,
    cutoff: _Cutoff = None,
    gravity: _Gravity = _UP,
    mask: _Mask = _USUAL.mask_part,
    slow: _Slow = _USUAL.slow_part,
    quiet: Quiet = False,
) -> None:
    """Identify inertia, friction and motors from a recording, and test what comes out on what was held out.

    Exit codes: 0 done, 1 the recording does not tell enough, 2 a file or an option is wrong.
    """
    _check(trust, json_file, fitted_urdf)
    with Terminal(quiet) as terminal:
        numbers = count(1)

        def step(text: str) -> None:
            terminal.step(next(numbers), STEPS + 2, text)

        step(f"read {urdf} and {data}")
        robot, log = _read(urdf, data, gravity)
        choice = ModelChoice(_terms(terms), _pairs(robot, coupled or ()), robust, slow, mask)
        step("low-pass, and every column of every sample")
        posed = _posed(robot, log, choice, cutoff, instruments)
        elsewhere = None if held_out is None else Elsewhere(held_out, _elsewhere(posed, held_out))
        try:
            found = identified(urdf, data, log, posed, step, trust, elsewhere)
        except RobotError as error:
            fail(f"{data}: {error}", EXIT_FAILED)
    for line in notes(found.report):
        terminal.note(line)
    for table in tables(found.report):
        print_table(table)
    try:
        if json_file is not None:
            write_report(json_file, found.report)
        if fitted_urdf is not None:
            _write_urdf(fitted_urdf, urdf, posed, found)
    except OSError as error:
        fail(f"{error.filename}: {error.strerror}", EXIT_USAGE)


def _check(trust: float, *outputs: Path | None) -> None:
    """Say before the work what would be wrong after it."""
    if not 0.0 < trust < float("inf"):
        fail(f"trust {trust}: it must be a number above 0", EXIT_USAGE)
    for path in outputs:
        if path is not None and not path.parent.is_dir():
            fail(f"{path}: there is no folder {path.parent}", EXIT_USAGE)


def _write_urdf(path: Path, given: Path, posed: Problem, found: Identified) -> None:
    if found.real is None:
        fail(f"{path}: not written, no real bodies: {found.report.fit.bodies_note}", EXIT_FAILED)
    friction = friction_of(posed.drives, found.real.drives.tolist(), len(posed.robot.bodies))
    write_fitted_urdf(path, given, posed.robot, found.real.bodies, friction)


def _read(urdf: Path, data: Path, gravity: str) -> tuple[UrdfRobot, JointLog]:
    try:
        robot = read_urdf(urdf, _gravity(gravity))
        return robot, read_log(data, robot.chain.serials)
    except (UrdfError, DataFileError) as error:
        fail(error, EXIT_USAGE)
    except OSError as error:
        fail(f"{error.filename}: {error.strerror}", EXIT_USAGE)


def _posed(
    robot: UrdfRobot, log: JointLog, choice: ModelChoice, cutoff: float | None, instruments: bool
) -> Problem:
    try:
        cutoff_hz = usual_cutoff_hz(log) if cutoff is None else cutoff
        most = most_samples(len(robot.bodies))
        if not instruments:
            return problem(robot, filtered_log(log, cutoff_hz, most), choice)
        one, again = (filtered_log(half, cutoff_hz, most) for half in in_two(log))
        return problem(robot, one, choice, again)
    except RobotError as error:
        fail(error, EXIT_USAGE)


def _elsewhere(posed: Problem, data: Path) -> Problem:
    """Pose another recording as the first one was, with its cut-off and its top speeds."""
    try:
        log = read_log(data, posed.robot.chain.serials)
        some = filtered_log(log, posed.log.cutoff_hz, most_samples(len(posed.robot.bodies)))
        return problem(posed.robot, some, posed.choice, top_rad_s=posed.log.top_rad_s)
    except OSError as error:
        fail(f"{error.filename}: {error.strerror}", EXIT_USAGE)
    except DataFileError as error:
        fail(error, EXIT_USAGE)
    except RobotError as error:
        fail(f"{data}: {error}", EXIT_USAGE)


def _gravity(text: str) -> list[float]:
    try:
        found = [float(word) for word in text.split(",")]
    except ValueError:
        found = []
    if len(found) != 3 or not all(abs(part) < 100.0 for part in found):
        fail(f"gravity {text!r}: it must be three numbers below 100, like {_UP}", EXIT_USAGE)
    return found


def _terms(text: str) -> tuple[Term, ...]:
    words = [word.strip() for word in text.split(",")]
    known = tuple(term for term in DRIVE_TERMS if term in words)
    if words == ["none"]:
        return ()
    if len(known) != len(words):
        fail(f"terms {text!r}: known are {', '.join(DRIVE_TERMS)}, each once, or none", EXIT_USAGE)
    return known


def _pairs(robot: UrdfRobot, texts: Sequence[str]) -> tuple[tuple[int, int], ...]:
    found = []
    for text in texts:
        joints = [_joint(robot, word.strip()) for word in text.split(",")]
        if len(joints) != 2 or joints[0] == joints[1]:
            fail(f"coupled {text!r}: it must be two different joints, like 5,6", EXIT_USAGE)
        found.append((joints[0], joints[1]))
    return tuple(found)


def _joint(robot: UrdfRobot, word: str) -> int:
    names = robot.chain.serials
    numbers = {str(i + 1): i for i in range(len(names))} | {name: i for i, name in enumerate(names)}
    if word not in numbers:
        fail(f"coupled: no joint {word!r}; the joints are 1 to {len(names)}: {', '.join(names)}", EXIT_USAGE)
    return numbers[word]
