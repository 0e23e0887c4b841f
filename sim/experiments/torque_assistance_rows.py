"""Torque assistance as plain figures: of every combination the rms errors of all modes, and who is unstable.

Each combination is one piece of work; robots are identified beforehand, or known without error.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sim.experiments.torque_assistance import Model, standing_robot
from sim.experiments.torque_assistance_cases import Case, Combination, robots_of, try_case
from sim.experiments.torque_assistance_table import combination_words
from sim.noise_profile import NoiseProfile
from sim.pose import read_only
from sim.robot_tree import true_chain, true_inertia


class AssistanceRow(NamedTuple):
    """What came of one combination, by input modes 1, 2 and 3.

    name: the combination in words. is_thesis: the thesis' arm, as against an arm of several joints; setting:
    the thesis' PID setting, None of the factory's gains. unstable: why a mode counts as such, empty if not.
    """

    name: str
    robot: str
    is_thesis: bool
    strategy: int
    setting: str | None
    rms_error_rad: tuple[float, float, float]
    unstable: tuple[str, str, str]

    @property
    def is_stable(self) -> bool:
        """Whether input mode 3 is."""
        return not self.unstable[2]

    @property
    def helps(self) -> bool:
        """Whether input mode 3 has the lowest error."""
        return self.rms_error_rad[2] < min(self.rms_error_rad[:2])

    @property
    def gain(self) -> float:
        """By how much mode 3 is better than mode 2."""
        return self.rms_error_rad[1] / self.rms_error_rad[2]


def true_model(name: str, seed: int) -> Model:
    """Return what a shipped robot is, where the seed puts it, as if it had been identified without error."""
    robot = standing_robot(name, seed)
    return Model(true_chain(robot), read_only(true_inertia(robot).reshape(-1)))


def assistance_row(case: Case, model: Model, noise: NoiseProfile, seed: int) -> AssistanceRow:
    """Try one combination in all input modes."""
    return row_of(try_case(case, model, noise, seed))


def assistance_rows(
    chosen: Sequence[Case], noise: NoiseProfile, seed: int, models: Mapping[str, Model] | None = None
) -> list[AssistanceRow]:
    """Try some combinations (see `torque_assistance_cases.cases`), one after the other.

    Robots that `models` does not have by name are known without error.
    """
    known = {name: true_model(name, seed) for name in robots_of(list(chosen)) if name not in (models or {})}
    known.update(models or {})
    return [assistance_row(case, known[case.robot], noise, seed) for case in chosen]


def row_of(found: Combination) -> AssistanceRow:
    """Return the plain figures of a combination."""
    first, second, third = found.follows
    return AssistanceRow(
        name=combination_words(found),
        robot=found.case.robot,
        is_thesis=found.case.alignment is not None,
        strategy=found.case.gains.strategy,
        setting=found.case.gains.setting,
        rms_error_rad=(first.rms_error_rad, second.rms_error_rad, third.rms_error_rad),
        unstable=(first.unstable, second.unstable, third.unstable),
    )
