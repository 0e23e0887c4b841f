"""What torque assistance came to: a table of rms tracking errors, the bars, and both as JSON."""

import json
from collections.abc import Callable, Sequence
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from rich.table import Table

from sim.experiments.torque_assistance import MODES, ON_MODULE, Follow
from sim.experiments.torque_assistance_cases import Combination

# What the six joints of an arm are to gain under torque control.
LEAST_GAIN = 3.0


class Bar(NamedTuple):
    """What is asked of all combinations of some kind, of how many it is true, and of which it is not."""

    asked: str
    stable: int
    kept: int
    missed: tuple[str, ...]
    unstable: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether every stable combination keeps it."""
        return self.kept == self.stable > 0


def bars(found: Sequence[Combination]) -> list[Bar]:
    """Judge all combinations: the thesis' arm under its gains and the factory's, and arms of six joints.

    Under strategy 3 calculated torque has its limits: an effort loop that is on gives way to what it does
    not know. With P the position's gain, E the effort's and F its feed-forward, a joint is as stiff as
    P / (E + F) [Nm/rad], and P / F without one. An arm that stands upright and whose weight turns it over
    faster than that falls, whatever it is told: it is unstable.
    """
    one = [each for each in found if each.case.alignment is not None]
    six = [each for each in found if each.case.alignment is None]
    judged = []
    for whose, thesis in (("thesis'", True), ("factory's", False)):
        own = [each for each in one if (each.case.gains.setting is not None) == thesis]
        asked = f"one joint, the {whose} gains: mode 3 has the lowest rms error"
        judged.append(_bar(asked, own, lambda each: each.helps))
    for strategy in (4, 3):
        own = [each for each in six if each.case.gains.strategy == strategy]
        asked = f"six joints, strategy {strategy}: mode 3 is {LEAST_GAIN:g} times lower than mode 2"
        judged.append(_bar(asked, own, lambda each: each.gain >= LEAST_GAIN))
    return [bar for bar in judged if bar.stable + len(bar.unstable)]


def _bar(asked: str, found: Sequence[Combination], keeps: Callable[[Combination], bool]) -> Bar:
    stable = [each for each in found if each.is_stable]
    missed = tuple(combination_words(each) for each in stable if not keeps(each))
    unstable = tuple(
        f"{combination_words(each)}: {each.follows[2].unstable}" for each in found if not each.is_stable
    )
    return Bar(asked, len(stable), len(stable) - len(missed), missed, unstable)


def assistance_table(found: Sequence[Combination]) -> Table:
    """Return the combinations as a table, a section for each robot; * marks what is unstable."""
    titles = (
        "robot",
        "gains",
        "read",
        "motion",
        "set-points",
        "asked",
        "mode 1",
        "mode 2",
        "mode 3",
        "2 / 3",
    )
    shown = Table(*titles, title="Rms tracking error by input mode in mrad, * unstable")
    for each, following in zip(found, [*found[1:], None], strict=True):
        case = each.case
        shown.add_row(
            _robot(each),
            case.gains.name,
            case.gains.reading or "",
            case.motion,
            case.delivery.name,
            f"{1e3 * each.follows[0].motion_rms_rad:.1f}",
            *(_error(one) for one in each.follows),
            f"{each.gain:.1f}" if isfinite(each.gain) else "",
            end_section=following is None or following.case.robot != case.robot,
        )
    return shown


def bar_lines(judged: Sequence[Bar]) -> list[str]:
    """Return the bars in words, and what is unstable below them."""
    lines = []
    for bar in judged:
        verdict = "holds" if bar.holds else "does not hold"
        lines.append(f"{bar.asked}: {verdict}, in {bar.kept} of {bar.stable} stable combinations")
        lines += [f"  not so: {words}" for words in bar.missed]
        lines += [f"  unstable: {words}" for words in bar.unstable]
    return lines


def write_assistance(path: Path, settings: dict[str, object], found: Sequence[Combination]) -> None:
    """Write settings, combinations and bars as JSON; an error that is infinite, as null.

    Raises:
        OSError: the file cannot be written.
    """
    document = {
        "settings": settings,
        "rows": [_row(each) for each in found],
        "bars": [bar._asdict() | {"holds": bar.holds} for bar in bars(found)],
    }
    path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _row(each: Combination) -> dict[str, object]:
    case = each.case
    modes = {
        str(mode): {
            "rms_error_rad": _number(one.rms_error_rad),
            "ringing_rad": _number(one.ringing_rad),
            "saturated": one.saturated,
            "thrown": one.thrown,
            "unstable": one.unstable,
        }
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


def _error(one: Follow) -> str:
    words = f"{1e3 * one.rms_error_rad:.2f}" if isfinite(one.rms_error_rad) else "-"
    return f"{words} *" if one.unstable else words


def _robot(each: Combination) -> str:
    return each.case.alignment or f"{each.case.robot} {each.case.pose}"


def combination_words(each: Combination) -> str:
    """Return a combination in words: robot, gains, motion, and where set-points come from if from a host."""
    case = each.case
    read = f" {case.gains.reading}" if case.gains.reading else ""
    delivered = "" if case.delivery == ON_MODULE else f", {case.delivery.name}"
    return f"{_robot(each)}, {case.gains.name}{read}, {case.motion}{delivered}"
