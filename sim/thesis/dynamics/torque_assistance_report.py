"""Results of torque assistance: the bars, a JSON file, and a picture.

The picture shows how the thesis' arm follows in the three input modes, as its figures 52 to 61 do.
"""

from collections.abc import Callable, Sequence
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from module_agent.model.errors import UsageError
from module_agent.model.files import write_json
from module_agent.model.read_only import read_only
from sim.imperfections.noise_profile import NoiseProfile
from sim.robot.robot_tree import true_chain, true_inertia
from sim.robot.variants import as_built
from sim.thesis.dynamics.torque_assistance import MODES, ON_MODULE, Model, standing_robot
from sim.thesis.dynamics.torque_assistance_cases import ABOUT_AS_WELL, Combination
from sim.thesis.published import ALIGNMENTS, READINGS, SETTINGS

# The required gain of an arm of six joints under torque control.
MIN_GAIN = 3.0


class Bar(NamedTuple):
    """A requirement on a kind of combinations, how many are stable, how many meet it, and which do not."""

    requirement: str
    stable: int
    met: int
    missed: tuple[str, ...]
    unstable: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether every stable combination meets it, and there is one."""
        return self.met == self.stable > 0


def bars(combinations: Sequence[Combination]) -> list[Bar]:
    """Check all combinations: the thesis' arm under its gains and the factory's, and arms of six joints.

    Under strategy 3 calculated torque has its limits: an active effort loop yields to unmodelled torque. With
    P the position's gain, E the effort's and F its feed-forward, a joint's stiffness is P / (E + F) [Nm/rad],
    and P / F without the loop. An upright arm whose weight has a larger negative stiffness falls with any
    feed-forward: it is unstable.
    """
    one = [each for each in combinations if each.case.alignment is not None]
    six = [each for each in combinations if each.case.alignment is None]
    checked = []
    for whose, thesis in (("thesis'", True), ("factory's", False)):
        own = [each for each in one if (each.case.gains.setting is not None) == thesis]
        requirement = f"one joint, the {whose} gains: mode 3 has the lowest rms error"
        requirement += f" (strategy 3: below {ABOUT_AS_WELL:g} times)" if thesis else ""
        checked.append(_bar(requirement, own, lambda each: each.helps))
    for strategy in (4, 3):
        own = [each for each in six if each.case.gains.strategy == strategy]
        requirement = f"six joints, strategy {strategy}: mode 3 is {MIN_GAIN:g} times lower than mode 2"
        checked.append(_bar(requirement, own, lambda each: each.gain >= MIN_GAIN))
    return [bar for bar in checked if bar.stable + len(bar.unstable)]


def _bar(requirement: str, combinations: Sequence[Combination], meets: Callable[[Combination], bool]) -> Bar:
    stable = [each for each in combinations if each.is_stable]
    missed = tuple(combination_text(each) for each in stable if not meets(each))
    unstable = tuple(
        f"{combination_text(each)}: {each.follows[2].unstable}" for each in combinations if not each.is_stable
    )
    return Bar(requirement, len(stable), len(stable) - len(missed), missed, unstable)


def write_assistance(path: Path, settings: dict[str, object], combinations: Sequence[Combination]) -> None:
    """Write settings, combinations and bars as JSON; an error that is infinite, as null.

    Raises:
        OSError: the file cannot be written.
    """
    document = {
        "settings": settings,
        "rows": [_row(each) for each in combinations],
        "bars": [bar._asdict() | {"holds": bar.holds} for bar in bars(combinations)],
    }
    write_json(path, document)


def _row(each: Combination) -> dict[str, object]:
    case = each.case
    names = ("rms_error_rad", "ringing_rad", "saturated", "duty_jumps")
    modes = {
        str(mode): {name: _number(getattr(one, name)) for name in names} | {"unstable": one.unstable}
        for mode, one in zip(MODES, each.follows, strict=True)
    }
    return {
        "robot": case.robot,
        "pose": case.pose,
        "strategy": case.gains.strategy,
        "gains": case.gains.name,
        "reading": case.gains.reading,
        "motion": case.motion,
        "delivery": case.delivery._asdict(),
        "motion_rms_rad": each.follows[0].motion_rms_rad,
        "modes": modes,
        "mode_2_over_3": _number(each.gain),
    }


def _number(value: float) -> float | None:
    return value if isfinite(value) else None


def robot_and_pose(each: Combination) -> str:
    """Return the alignment of the thesis' arm, or robot and pose of another one."""
    return each.case.alignment or f"{each.case.robot} {each.case.pose}"


def combination_text(each: Combination) -> str:
    """Return a combination as text: robot, gains, motion, and the delivery of set-points by a host."""
    case = each.case
    read = f" {case.gains.reading}" if case.gains.reading else ""
    delivered = "" if case.delivery == ON_MODULE else f", {case.delivery.name}"
    return f"{robot_and_pose(each)}, {case.gains.name}{read}, {case.motion}{delivered}"


def true_model(name: str, seed: int, noise: NoiseProfile) -> Model:
    """Return the true model of a shipped robot as the seed builds and places it, not an identified one."""
    robot = as_built(standing_robot(name, seed), seed, noise)
    return Model(true_chain(robot), read_only(true_inertia(robot).reshape(-1)))


_COMMANDED = "#202020"
_MODES = {
    "mode 1: position": "#d07a1f",
    "mode 2: position and velocity": "#1f5fa8",
    "mode 3: position, velocity and calculated torque": "#2c8a4b",
}
# The thesis' figures by alignment and setting; where it found nothing stable it has none.
_FIGURES = {("vertical", f"#{k}"): 51 + k for k in range(1, 7)} | {
    ("horizontal", f"#{k}"): 55 + k for k in range(4, 7)
}
_SAMPLE_S = 0.004
_COLUMNS = 3


def plot_assistance(combinations: Sequence[Combination], path: Path, title: str) -> None:
    """Draw the thesis' settings and save (PNG, SVG or PDF by suffix): a panel for each with all modes.

    Raises:
        UsageError: none of the combinations is one of the thesis', or matplotlib cannot write the suffix.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    panels = [
        _first(combinations, alignment, each.name) for alignment in ALIGNMENTS[::-1] for each in SETTINGS
    ]
    if not any(panels):
        raise UsageError("no combination of the thesis' arm and settings: nothing to draw")
    figure = Figure(figsize=(13.5, 12.0), dpi=120)
    grid: Any = figure.subplots(len(panels) // _COLUMNS, _COLUMNS, squeeze=False)
    for axes, one in zip(grid.flat, panels, strict=True):
        if one is None:
            axes.set_axis_off()
        else:
            _panel(axes, one)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    for row in grid:
        row[0].set_ylabel("position [rad]")
    figure.suptitle(title, fontsize=12, y=0.99)
    handles = [Line2D([], [], color=_COMMANDED, linewidth=1.0, linestyle="--", label="commanded")]
    handles += [Line2D([], [], color=colour, label=label) for label, colour in _MODES.items()]
    figure.legend(handles=handles, loc="lower center", ncol=4, fontsize=10, frameon=False)
    figure.subplots_adjust(left=0.06, right=0.985, top=0.94, bottom=0.075, wspace=0.18, hspace=0.33)
    figure.savefig(path)


def _first(combinations: Sequence[Combination], alignment: str, setting: str) -> Combination | None:
    """Return the first combination of an alignment and a setting, on the module and in the first reading."""
    wanted = (alignment, setting, READINGS[0], ON_MODULE)
    for each in combinations:
        case = each.case
        if (case.alignment, case.gains.setting, case.gains.reading, case.delivery) == wanted:
            return each
    return None


def _panel(axes: Any, one: Combination) -> None:
    case = one.case
    axes.grid(True, linewidth=0.4, color="#d5d5d5")
    for each, colour in zip(one.follows, _MODES.values(), strict=True):
        t_s = _SAMPLE_S * np.arange(len(each.true_rad))
        # A ringing motion would hide the others: it is drawn thin and pale.
        style = {"linewidth": 0.6, "alpha": 0.6} if each.unstable else {"linewidth": 1.3}
        axes.plot(t_s, each.true_rad[:, :1], color=colour, **style)
    longest = max(one.follows, key=lambda each: len(each.commanded_rad))
    t_s = _SAMPLE_S * np.arange(len(longest.commanded_rad))
    axes.plot(t_s, longest.commanded_rad[:, :1], color=_COMMANDED, linewidth=1.0, linestyle="--")
    rms = " / ".join(
        f"{1e3 * each.rms_error_rad:.1f}" + ("*" if each.unstable else "") for each in one.follows
    )
    number = _FIGURES.get((case.alignment or "", case.gains.name))
    figure = f"figure {number}" if number is not None else "no figure"
    axes.set_title(
        f"{case.alignment}, strategy {case.gains.strategy}, {case.gains.name} ({figure})\n"
        f"{case.motion}, rms error {rms} mrad",
        fontsize=9,
    )
