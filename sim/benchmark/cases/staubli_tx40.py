"""A real arm's recording: torques of the half that was not fitted to, all samples and those that move."""

from collections.abc import Sequence
from pathlib import Path

from coordinator.arm_fit.fit_dynamics import fit_dynamics
from coordinator.arm_fit.problem import ModelChoice
from coordinator.arm_fit.report import FitReport
from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row, scaled

URDF, MOTION = "tx40.urdf", "motion.npz"
# What weighted least squares with the same terms reaches elsewhere on a Staubli TX40.
ALL_PERCENT, MASKED_PERCENT = 12.3, 7.9
# The bar for real bodies with the friction that is chosen here.
BODIES_ALL_PERCENT, BODIES_MASKED_PERCENT = 7.5, 4.9
# Its wrist's two motors share a drive.
_COUPLED = ((4, 5),)


def recorded_cases(folder: Path) -> list[Case]:
    """Return the one case, of a Staubli TX40: `tx40.urdf` and `motion.npz` in a folder."""
    return [
        Case("TX40, halves of the run", [Trial(fitted, (folder,), 6.0)], _summary, "a real arm", "its URDF")
    ]


def fitted(folder: Path) -> FitReport:
    """Fit one half and try the other, both ways."""
    return fit_dynamics(folder / URDF, folder / MOTION, choice=ModelChoice(coupled=_COUPLED)).report


def _summary(reports: Sequence[FitReport]) -> Summary:
    rows = []
    for report in reports:
        for samples, limit, bodies_limit in (
            ("all", ALL_PERCENT, BODIES_ALL_PERCENT),
            ("masked", MASKED_PERCENT, BODIES_MASKED_PERCENT),
        ):
            errors = {
                (one.model, one.torque): scaled(one.overall, 100.0)
                for one in report.held_out
                if one.tried_on == "both" and one.samples == samples
            }
            figure = f"held-out torque, {samples} samples"
            rows += [
                Row(f"{figure} [%]", errors["fitted", "filtered"], limit),
                Row(f"{figure}, real bodies [%]", errors["bodies", "filtered"], bodies_limit),
                Row(f"{figure}, raw [%]", errors["fitted", "raw"]),
            ]
    return Summary(rows)
