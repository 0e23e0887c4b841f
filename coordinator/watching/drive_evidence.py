"""What motor currents say of a drive's friction: the motor's torque against the spring's.

A motor that turns at w (seen at the output) with current i, behind a gear of ratio N that passes on a share
eta of what drives and all of what is driven back, has

    m = k N i (eta or 1) = c tau + l sign(w) |tau| + Fc sign(w) + Fv w + J w' + offset,

tau the spring's torque, c and l what motor constant and losses are off their type's (1 and 0; Khalil and
Dombre 2002, section 9.6, for the rest). The motor's side stands alone on the left, as a joint that carries
nothing would else be explained best by no motor at all. Only where the motor turns is friction what it seems,
so that slow samples do not count.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coordinator.watching.evidence import Evidence, compressed, joined, without_own
from coordinator.watching.stretch import Stretch
from module_agent.catalogue import ModuleType
from module_agent.dynamics.chain import Array

# c, l, Fc, Fv, J, offset: Fc and Fv are what changes.
TERMS = 6
_COULOMB, _VISCOUS = 2, 3
# Of the largest speed; below, a motor may stick within its tick.
SLOW_SHARE = 0.04
# Of the low-pass: what is farther has no say.
REACH_SAMPLES = 10
FEWEST = 20
# Of c and l: what a joint that carries little tells of them is not what they are under another load.
OWN_SIGMA = np.array([0.1, 0.1])


class DriveModel(NamedTuple):
    """A joint's drive: its parameters (6,), and its scatter [Nm] as if samples were independent."""

    kind: ModuleType
    theta: Array
    sigma_nm: float

    def friction_nm(self, speed_rad_s: float, change: Array | None = None) -> float:
        """Return the friction at a speed, of this drive or of one that has changed by (2,)."""
        coulomb, viscous = self.theta[[_COULOMB, _VISCOUS]] + (0.0 if change is None else change)
        return float(coulomb + viscous * speed_rad_s)

    @property
    def typical_rad_s(self) -> float:
        """Half of the largest speed."""
        return 0.5 * self.kind.max_speed_rad_s

    @property
    def prior_sigma(self) -> Array:
        """How far its parameters may be from where they are (6,): gears and motors of a type are alike."""
        motor = self.kind.motor
        return np.array(
            [
                *(0.05, 0.1),
                max(motor.coulomb_nm, 0.01) * 2.0,
                max(motor.viscous_nm_s_rad, 0.01) * 2.0,
                motor.rotor_inertia_kg_m2 * self.kind.gear_ratio**2,
                0.05 * self.kind.max_effort_nm,
            ]
        )

    @property
    def change(self) -> Array:
        """The hypothesis: Coulomb and viscous friction change, by as much as the catalogue has them."""
        found = np.zeros((TERMS, 2))
        found[_COULOMB, 0] = self.kind.motor.coulomb_nm
        found[_VISCOUS, 1] = self.kind.motor.viscous_nm_s_rad
        return found

    def change_of(self, size: Array) -> Array:
        """Return the change (2,) of Coulomb [Nm] and viscous friction [Nm s/rad], of a `Change`'s size."""
        return np.asarray(size * [self.kind.motor.coulomb_nm, self.kind.motor.viscous_nm_s_rad])


def drive_rows(kind: ModuleType, stretch: Stretch, joint: int) -> tuple[Array, Array]:
    """Return the rows (k, 6) and motor torques (k,) [Nm] of the samples in which the motor of a joint turns.

    All signals went through the same low-pass, which reaches into what is around a sample.
    """
    speed = stretch.raw.motor_rad_s[:, joint] / kind.gear_ratio
    slow = np.abs(speed) < SLOW_SHARE * kind.max_speed_rad_s
    turning = np.convolve(slow, np.ones(2 * REACH_SAMPLES + 1), mode="same") == 0
    driving, driven, loss, sign, turned, change = stretch.drive[:, joint].T
    per_amp = kind.gear_ratio * kind.motor.back_emf_v_s_rad
    motor = per_amp * (kind.motor.efficiency * driving + driven)
    speeds = turned / kind.gear_ratio, change / kind.gear_ratio
    rows = np.column_stack([stretch.tau_nm[:, joint], loss, sign, *speeds, np.ones_like(sign)])
    return rows[turning], motor[turning]


def drive_evidence(model: DriveModel, stretch: Stretch, joint: int) -> Evidence | None:
    """Return the evidence about the drive's deviation from its model; None if the motor stood.

    Before the six parameters are those of how torque is passed on, the stretch's own (2,): see `OWN_SIGMA`.
    """
    rows, torque = drive_rows(model.kind, stretch, joint)
    if len(rows) < FEWEST:
        return None
    weighted = np.column_stack([rows[:, : OWN_SIGMA.size], rows]) / model.sigma_nm
    return compressed(weighted, (torque - rows @ model.theta) / model.sigma_nm)


def drive_window(parts: Sequence[Evidence]) -> Evidence:
    """Return the evidence (k, 6) of a window's stretches together."""
    return without_own(joined(parts), OWN_SIGMA)


def fitted_drive(kind: ModuleType, rows: Array, torque_nm: Array) -> Array:
    """Return the parameters (6,) that explain a drive's torques best.

    A drive that hardly moved keeps what its type's catalogue says, as far as the samples leave it open.
    """
    expected = catalogued_drive(kind)
    sigma = 0.01 * kind.max_effort_nm
    prior = DriveModel(kind, expected, sigma).prior_sigma
    stacked = np.vstack([rows / sigma, np.diag(1.0 / prior)])
    target = np.concatenate([(torque_nm - rows @ expected) / sigma, np.zeros(TERMS)])
    change = np.linalg.lstsq(stacked, target, rcond=None)[0]
    found: Array = expected + change
    found.flags.writeable = False
    return found


def catalogued_drive(kind: ModuleType) -> Array:
    """Return a drive's parameters (6,) by its type."""
    motor = kind.motor
    inertia = motor.rotor_inertia_kg_m2 * kind.gear_ratio**2
    return np.array([1.0, 0.0, motor.coulomb_nm, motor.viscous_nm_s_rad, inertia, 0.0])
