"""`x5-coordinator excite`: the motion to run on any arm, so that `fit-dynamics` learns most from it."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from coordinator.commands.options import Quiet
from coordinator.description.shape_clearance import ClearanceCheck, clearance_check
from coordinator.description.urdf_reader import UrdfRobot, read_urdf
from coordinator.description.urdf_shapes import read_shapes
from coordinator.excitation.urdf_motion import (
    ROUNDS,
    Design,
    MotionTask,
    design_motion,
    write_motion,
)
from coordinator.runtime.command_line import in_a_folder
from coordinator.runtime.terminal import Terminal, new_table, print_table
from module_agent.model.chain import Array
from module_agent.model.errors import UsageError

# Where a URDF gives no limit: slow enough for any arm.
_UNKNOWN_RAD_S, _UNKNOWN_RAD = 1.0, np.pi
# By default a joint takes so long to its top speed.
_TO_SPEED_S = 0.5
# Share of the range that home must be away from its ends to be zero.
_INSIDE = 0.1

_Urdf = Annotated[Path, typer.Option(help="URDF file: revolute, continuous and fixed joints.")]
_Out = Annotated[Path, typer.Option(help="CSV file to write the motion to.", callback=in_a_folder)]
_Home = Annotated[
    str | None,
    typer.Option(
        help="Positions [rad] where the motion begins and ends, by commas; by default zero, or the middle of "
        "the range of a joint for which zero is near an end of it. The arm must be clear of itself there."
    ),
]
_Rate = Annotated[float, typer.Option(help="Samples per second.", min=10.0, max=10000.0)]
_Period = Annotated[float, typer.Option(help="Seconds after which the motion repeats.", min=1.0, max=600.0)]
_Periods = Annotated[int, typer.Option(help="Repetitions.", min=1, max=100)]
_Harmonics = Annotated[
    int, typer.Option(help="Sines of each joint's series; the last has this many periods.")
]
_Speed = Annotated[float | None, typer.Option(help="Top speed of all joints [rad/s], at most the URDF's.")]
_Accel = Annotated[
    float | None,
    typer.Option(help="Top acceleration of all joints [rad/s^2]; by default top speed within 0.5 s."),
]
_Clearance = Annotated[float, typer.Option(help="Distance that links keep from each other [m].", min=0.0)]
_Floor = Annotated[
    float | None, typer.Option(help="Height of a floor above the root link's frame [m]; by default none.")
]
_NoCollisions = Annotated[bool, typer.Option("--no-collisions", help="Do not check collisions.")]
_Tries = Annotated[int, typer.Option(help="Motions that are tried.", min=20, max=1000000)]
_Seed = Annotated[int, typer.Option(help="Seed of the search; another motion for another.", min=0)]


def excite(
    urdf: _Urdf,
    out: _Out,
    home: _Home = None,
    rate: _Rate = 250.0,
    period: _Period = 10.0,
    periods: _Periods = 3,
    harmonics: _Harmonics = 5,
    speed: _Speed = None,
    acceleration: _Accel = None,
    clearance: _Clearance = 0.02,
    floor: _Floor = None,
    no_collisions: _NoCollisions = False,
    tries: _Tries = 2000,
    seed: _Seed = 0,
    quiet: Quiet = False,
) -> None:
    """Design the motion of an arm from which fit-dynamics learns most, and write it as CSV.

    Limits of position, speed and torque are the URDF's, collisions are checked by its collision shapes: what
    is not in it (tools, cables, the surroundings) is not known. The motion begins and ends at rest at home.

    Exit codes: 0 done, 1 no motion is possible, 2 a file or an option is wrong.
    """
    robot = read_urdf(urdf)
    task = _task(robot, home, speed, acceleration, period, harmonics)
    if harmonics / period > 0.25 * rate:
        raise UsageError(f"rate {rate:g} Hz: sines of {harmonics / period:g} Hz need at least 4 times theirs")
    with Terminal(quiet) as terminal:
        if not no_collisions:
            check = _check(robot, task.home_rad, clearance, floor)
            task = task._replace(clearance=check)
            for one, other in check.touching:
                terminal.note(f"not checked: {one} and {other}, whose shapes overlap at home")
            if not check.pairs.size:
                terminal.note("no pair of links has collision shapes: collisions are not checked")
        design = design_motion(
            task, np.random.default_rng(seed), tries, lambda k, text: terminal.step(k, ROUNDS, text)
        )
    samples = write_motion(out, task, design.motion, periods, rate)
    _print(task, design)
    typer.echo(
        f"{out}: {samples} samples at {rate:g} Hz, {periods} x {period:g} s; condition number "
        f"{design.condition:.0f} for {design.rank} parameters, {design.random_condition:.0f} of random ones"
    )


def _task(
    robot: UrdfRobot,
    home: str | None,
    speed: float | None,
    acceleration: float | None,
    period: float,
    harmonics: int,
) -> MotionTask:
    if harmonics < 2:
        raise UsageError(f"harmonics {harmonics}: at least 2 are needed to begin at rest")
    for name, value in (("speed", speed), ("acceleration", acceleration)):
        if value is not None and not 0.0 < value < np.inf:
            raise UsageError(f"{name} {value}: it must be a number above 0")
    low, high, top = robot.limits.T
    low, high = (
        np.where(np.isfinite(low), low, -_UNKNOWN_RAD),
        np.where(np.isfinite(high), high, _UNKNOWN_RAD),
    )
    unlimited = np.where(np.isfinite(top), top, _UNKNOWN_RAD_S if speed is None else speed)
    top = np.minimum(unlimited, np.inf if speed is None else speed)
    effort = robot.effort_nm
    return MotionTask(
        robot=robot,
        low_rad=low,
        high_rad=high,
        speed_rad_s=top,
        accel_rad_s2=top / _TO_SPEED_S if acceleration is None else np.full(len(top), acceleration),
        effort_nm=effort,
        # A reading is as noisy as its sensor is large.
        sigma_nm=0.01 * (effort if np.isfinite(effort).all() else np.ones(len(top))),
        home_rad=_home(robot, home, low, high),
        period_s=period,
        harmonics=harmonics,
        clearance=None,
    )


def _home(robot: UrdfRobot, text: str | None, low: Array, high: Array) -> Array:
    if text is None:
        margin = _INSIDE * (high - low)
        return np.where((low + margin < 0.0) & (high - margin > 0.0), 0.0, 0.5 * (low + high))
    names = robot.chain.serials
    try:
        home = np.array([float(cell) for cell in text.split(",")])
    except ValueError:
        home = np.zeros(0)
    if home.shape != low.shape or not np.isfinite(home).all():
        raise UsageError(f"home {text!r}: it must be {len(names)} numbers, of {', '.join(names)}")
    for name, q, least, most in zip(names, home, low, high, strict=True):
        if not least < q < most:
            raise UsageError(
                f"home of {name!r}: {q:g} rad is not within its range, {least:g} to {most:g} rad"
            )
    return home


def _check(robot: UrdfRobot, home: Array, clearance: float, floor: float | None) -> ClearanceCheck:
    shapes = read_shapes(robot)
    if floor is not None:
        shapes = shapes.with_floor(floor, robot.chain.gravity)
    return clearance_check(robot.chain, shapes, home, clearance)


def _print(task: MotionTask, design: Design) -> None:
    t_s = np.linspace(0.0, task.period_s, 2000)
    q, qd, qdd = design.motion.sampled(t_s)
    table = new_table(
        "Motion, and limits",
        "joint | >from [rad] | >to [rad] | >range [rad] | >speed [rad/s] | >limit | >acceleration [rad/s^2] "
        "| >limit",
    )
    for i, name in enumerate(task.robot.chain.serials):
        table.add_row(
            name,
            f"{q[:, i].min():.2f}",
            f"{q[:, i].max():.2f}",
            f"{task.low_rad[i]:.2f} .. {task.high_rad[i]:.2f}",
            f"{np.abs(qd[:, i]).max():.2f}",
            f"{task.speed_rad_s[i]:.2f}",
            f"{np.abs(qdd[:, i]).max():.2f}",
            f"{task.accel_rad_s2[i]:.2f}",
        )
    print_table(table)
    if task.clearance is not None and task.clearance.pairs.size:
        apart = task.clearance.clearance_m(q)
        one, other = task.clearance.pairs[:, int(apart.min(axis=0).argmin())]
        links = task.clearance.shapes.link
        typer.echo(f"Least clearance: {1e3 * apart.min():.0f} mm, {links[one]} from {links[other]}")
