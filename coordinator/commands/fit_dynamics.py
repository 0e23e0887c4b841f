"""`x5-coordinator fit-dynamics`: the dynamics of any arm from its URDF and recorded torques."""

from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from coordinator.arm_fit import fit_dynamics as arm_fit
from coordinator.arm_fit.consistent_bodies import USUAL_TRUST
from coordinator.arm_fit.fit import STEPS
from coordinator.arm_fit.payload import KnownPayload
from coordinator.arm_fit.predictions import write_matrices, write_predictions
from coordinator.arm_fit.problem import ModelChoice
from coordinator.commands.options import JsonFile, Quiet
from coordinator.commands.views.fit_dynamics import notes, page, tables
from coordinator.description.urdf_reader import STANDARD_GRAVITY, UrdfRobot, read_urdf
from coordinator.dynamics.drive_model import USUAL_TERMS
from coordinator.report.pages import html_page
from coordinator.report.plots import check_plots
from coordinator.runtime.command_line import in_a_folder
from coordinator.runtime.terminal import Terminal, print_table, write_result
from module_agent.model.errors import UsageError
from module_agent.model.files import write_text
from module_agent.signals.torque_terms import DRIVE_TERMS, Term

_UP = ",".join(f"{part:g}" for part in STANDARD_GRAVITY)
_USUAL_TERMS = ",".join(USUAL_TERMS)
_USUAL = ModelChoice()
_TRIED = ",".join(_USUAL.tried)


_Urdf = Annotated[Path, typer.Option(help="URDF file: revolute, continuous and fixed joints.")]
_Data = Annotated[
    list[Path],
    typer.Option(
        help="MCAP with JointState; CSV with t_s, q_JOINT_rad, tau_JOINT_nm and, if measured, "
        "qd_JOINT_rad_s; or npz with position_rad, torque, sample_rate_hz or t_s, and perhaps velocity_rad_s "
        "and joint_names. Repeat for several recordings."
    ),
]
_HeldOut = Annotated[
    Path | None,
    typer.Option(help="Another recording of the arm, CSV or npz, to test the fit to the whole of --data on."),
]
_Gain = Annotated[
    list[str] | None,
    typer.Option(
        help="JOINT=NM_PER_A: torque constant, gear included, of a joint whose current i_JOINT_a (current_a) "
        "was recorded. Repeat for several."
    ),
]
_Html = Annotated[
    Path | None,
    typer.Option(
        "--html", help="HTML file with the tables and a plot of each joint's torque.", callback=in_a_folder
    ),
]
_Predictions = Annotated[
    Path | None,
    typer.Option(
        help="CSV file of torques: measured, filtered, fitted, and predicted by the other half.",
        callback=in_a_folder,
    ),
]
_Matrices = Annotated[
    Path | None,
    typer.Option(
        help="npz file of base parameters with covariance and grouping matrix.", callback=in_a_folder
    ),
]
_FittedUrdf = Annotated[
    Path | None,
    typer.Option(help="File to write the URDF with the fitted bodies and friction to.", callback=in_a_folder),
]
_Trust = Annotated[float, typer.Option(help="Weight of the URDF's inertias as the prior of the bodies.")]
_Terms = Annotated[str, typer.Option(help=f"Terms of the drives, of {', '.join(DRIVE_TERMS)}; or none.")]
_Tried = Annotated[
    str,
    typer.Option(help="Terms to try joint by joint, and to keep where they pay on held-out data; or none."),
]
_Coupled = Annotated[
    list[str] | None,
    typer.Option(
        help="Two joints that share a drive, by number or name: 5,6. Repeat for several; none for none. By "
        "default neighbouring joints are tried."
    ),
]
_Robust = Annotated[bool, typer.Option("--robust", help="Huber's weights: outliers count less.")]
_Instruments = Annotated[
    bool,
    typer.Option(
        "--instruments",
        help="Instrumental variables: every other sample is an instrument for the rest, so that encoder "
        "noise does not bias the inertias. Fits half of the samples.",
    ),
]
_Cutoff = Annotated[
    float | None,
    typer.Option(
        help="Low-pass over motion and torque [Hz]; by default that of the least raw error between halves."
    ),
]
_Gravity = Annotated[
    str, typer.Option(help="Specific force at rest in the root link's frame [m/s^2], upwards.")
]
_Mask = Annotated[float, typer.Option(help="Part of a joint's top speed below which samples are masked.")]
_Slow = Annotated[float, typer.Option(help="Part of a joint's top speed below which Coulomb friction fades.")]
_Baseline = Annotated[
    Path | None,
    typer.Option(help="JSON report of a fit of the arm without the payload that it carries in --data."),
]
_PayloadBody = Annotated[
    str | None, typer.Option(help="Link that carries the payload; by default the last body's.")
]
_Loaded = Annotated[
    Path | None,
    typer.Option(
        help="Recording with the --known-payload, which --data is without: the two tell torque constants."
    ),
]
_KnownPayload = Annotated[
    str | None,
    typer.Option(
        help="MASS,X,Y,Z: what the arm carries in --loaded [kg], and its centre in the frame of the "
        "--payload-body [m]."
    ),
]
_Unchecked = Annotated[
    bool,
    typer.Option("--unchecked", help="Fit even if units, signs, gravity or length of the data look wrong."),
]


def fit_dynamics(
    urdf: _Urdf,
    data: _Data,
    held_out: _HeldOut = None,
    gain: _Gain = None,
    json_file: JsonFile = None,
    html_file: _Html = None,
    predictions: _Predictions = None,
    matrices: _Matrices = None,
    fitted_urdf: _FittedUrdf = None,
    trust: _Trust = USUAL_TRUST,
    terms: _Terms = _USUAL_TERMS,
    tried: _Tried = _TRIED,
    coupled: _Coupled = None,
    robust: _Robust = False,
    instruments: _Instruments = False,
    cutoff: _Cutoff = None,
    gravity: _Gravity = _UP,
    mask: _Mask = _USUAL.mask_part,
    slow: _Slow = _USUAL.slow_part,
    baseline: _Baseline = None,
    payload_body: _PayloadBody = None,
    loaded: _Loaded = None,
    known_payload: _KnownPayload = None,
    unchecked: _Unchecked = False,
    quiet: Quiet = False,
) -> None:
    """Identify inertia, friction and motors of an arm, and test the result on samples that were held out.

    Exit codes: 0 done, 1 the recording does not determine the parameters, 2 a file or an option is wrong.
    """
    if html_file is not None:
        check_plots()
    numbers = count(1)
    with Terminal(quiet) as terminal:
        robot = read_urdf(urdf, _gravity(gravity))
        fit = arm_fit.fit_dynamics(
            robot,
            data,
            held_out=held_out,
            gains=_gains(gain or ()),
            choice=ModelChoice(
                _terms("--terms", terms),
                _pairs(robot, coupled),
                robust,
                slow,
                mask,
                _terms("--tried", tried),
            ),
            instruments=instruments,
            cutoff_hz=cutoff,
            trust=trust,
            checked=not unchecked,
            baseline=baseline,
            payload_body=payload_body if known_payload is None else None,
            loaded=loaded,
            known_payload=_known_payload(known_payload, payload_body),
            progress=lambda text: terminal.step(next(numbers), STEPS, text),
        )
    for line in notes(fit.report):
        terminal.note(line)
    if write_result(json_file, fit.report):
        for table in tables(fit.report):
            print_table(table)
    if html_file is not None:
        write_text(html_file, html_page(page(fit.report, fit.torques)))
    if predictions is not None:
        write_predictions(predictions, fit.torques)
    if matrices is not None:
        write_matrices(matrices, fit.base)
    if fitted_urdf is not None:
        fit.write_urdf(fitted_urdf)


def _gravity(text: str) -> list[float]:
    try:
        gravity = [float(word) for word in text.split(",")]
    except ValueError:
        gravity = []
    if len(gravity) != 3 or not all(abs(part) < 100.0 for part in gravity):
        raise UsageError(f"gravity {text!r}: it must be three numbers below 100, like {_UP}")
    return gravity


def _known_payload(text: str | None, link: str | None) -> KnownPayload | None:
    if text is None:
        return None
    try:
        mass, x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"known payload {text!r}: it must be its mass [kg] and its centre [m], like 0.8,0.03,0,0.09"
        ) from None
    return KnownPayload(mass, (x, y, z), link)


def _gains(texts: Sequence[str]) -> dict[str, float]:
    gains = {}
    for text in texts:
        joint, _, number = text.rpartition("=")
        try:
            gains[joint] = float(number)
        except ValueError:
            gains[joint] = 0.0
        if not joint or not 0.0 < abs(gains[joint]) < np.inf:
            raise UsageError(f"gain {text!r}: it must be a joint and its Nm per A, like elbow=8.5")
    return gains


def _terms(option: str, text: str) -> tuple[Term, ...]:
    words = [word.strip() for word in text.split(",")]
    known = tuple(term for term in DRIVE_TERMS if term in words)
    if words == ["none"]:
        return ()
    if len(known) != len(words):
        raise UsageError(f"{option} {text!r}: known are {', '.join(DRIVE_TERMS)}, each once, or none")
    return known


def _pairs(robot: UrdfRobot, texts: Sequence[str] | None) -> tuple[tuple[int, int], ...] | None:
    if texts is None:
        return None
    pairs = []
    for text in texts if texts != ["none"] else ():
        joints = [_joint(robot, word.strip()) for word in text.split(",")]
        if len(joints) != 2 or joints[0] == joints[1]:
            raise UsageError(f"coupled {text!r}: it must be two different joints, like 5,6")
        pairs.append((joints[0], joints[1]))
    return tuple(pairs)


def _joint(robot: UrdfRobot, word: str) -> int:
    names = robot.chain.serials
    numbers = {str(i + 1): i for i in range(len(names))} | {name: i for i, name in enumerate(names)}
    if word not in numbers:
        raise UsageError(f"coupled: no joint {word!r}; the joints are 1 to {len(names)}: {', '.join(names)}")
    return numbers[word]
