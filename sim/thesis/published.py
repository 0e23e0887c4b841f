"""Published figures of the thesis.

One-joint arms and the lengths measured on them: chapter 6.2, tables 4 and 5. Dynamic identification: table 6,
sections 6.3.1 to 6.3.3. PID settings of the torque assistance: tables 7, 8 and 9 (8 and 9 are alike).
"""

from typing import Literal, NamedTuple

from module_agent.control.gains import default_gains
from module_agent.model.catalogue import ModuleType
from module_agent.model.errors import UsageError
from module_agent.wire.messages import GainSet, PidGains

Alignment = Literal["horizontal", "vertical"]

ALIGNMENTS: tuple[Alignment, ...] = ("horizontal", "vertical")
LENGTHS_MM = (484, 350, 245, 171)
# Chapter 6.2.1.2.1: 0.02 rad to 0.28 rad by 0.02 rad.
AMPLITUDES_RAD = tuple(round(0.02 * step, 2) for step in range(1, 15))
TRIALS = 13


class ThesisLength(NamedTuple):
    """The amplitude that the thesis chose for a length, and the mean of its thirteen trials there."""

    alignment: Alignment
    length_mm: int
    amplitude_rad: float
    mean_mm: float


THESIS_LENGTHS: tuple[ThesisLength, ...] = (
    ThesisLength("horizontal", 484, 0.09, 479.6),
    ThesisLength("horizontal", 350, 0.11, 335.5),
    ThesisLength("horizontal", 245, 0.2, 245.5),
    ThesisLength("horizontal", 171, 0.2, 167.0),
    ThesisLength("vertical", 484, 0.12, 482.3),
    ThesisLength("vertical", 350, 0.08, 360.0),
    ThesisLength("vertical", 245, 0.03, 264.7),
    ThesisLength("vertical", 171, 0.04, 188.0),
)


def thesis_length(alignment: Alignment, length_mm: int) -> ThesisLength:
    """Look up the thesis' result for an arm.

    Raises:
        UsageError: the thesis had no such arm; the message lists its lengths.
    """
    for each in THESIS_LENGTHS:
        if (each.alignment, each.length_mm) == (alignment, length_mm):
            return each
    raise UsageError(
        f"the thesis had no {alignment} arm of {length_mm} mm; its lengths are "
        f"{', '.join(map(str, LENGTHS_MM))} mm"
    )


# Section 6.3 has one arm.
DYNAMIC_LENGTH_MM = 484
# Table 2 [kg].
MODULE_KG = 0.306


class DynamicMotion(NamedTuple):
    """The windowed sine that the dynamic pattern is cut out of."""

    frequency_hz: float
    centre_s: float
    sigma_s: float


# Table 6.
DYNAMIC_MOTION = DynamicMotion(frequency_hz=1.0, centre_s=2.5, sigma_s=0.1)


class DynamicSearch(NamedTuple):
    """The amplitudes of an alignment in section 6.3.1, and the parameters identified at the chosen one.

    squared_error_nm2: the least-squares error by amplitude where it is printed. mcx_kg_m, izz_kg_m2: of the
    vector of section 6.3.2 or 6.3.3.
    """

    alignment: Alignment
    amplitudes_rad: tuple[float, ...]
    chosen_rad: float
    squared_error_nm2: dict[float, float]
    mcx_kg_m: float
    izz_kg_m2: float


DYNAMIC_SEARCHES: dict[Alignment, DynamicSearch] = {
    "vertical": DynamicSearch(
        "vertical", (0.1, 0.2, 0.3, 0.4, 0.9), 0.2, {0.9: 107.0, 0.4: 12.4, 0.2: 2.0}, 0.2249, 0.0725
    ),
    "horizontal": DynamicSearch("horizontal", (0.6, 1.4, 2.0), 2.0, {}, -0.0083, 0.1680),
}


# The thesis gives numbers without units. Integral and derivative gains are either per second, as in this
# firmware, or per tick of 1 ms.
Reading = Literal["per second", "per tick"]
READINGS: tuple[Reading, ...] = ("per tick", "per second")
TICK_S = 1e-3


class Terms(NamedTuple):
    """Proportional, integral and derivative gain of one loop."""

    kp: float
    ki: float
    kd: float


class PidSetting(NamedTuple):
    """A control strategy and its loops' gains, as the thesis prints them."""

    name: str
    strategy: int
    position: Terms
    velocity: Terms
    effort: Terms


_S3_POSITION, _S3_VELOCITY = Terms(4.5, 0.1, 1.8), Terms(3.7864, 0.0, 1.7)

SETTINGS: tuple[PidSetting, ...] = (
    PidSetting("#1", 3, _S3_POSITION, _S3_VELOCITY, Terms(0.12, 0.0008, 0.2)),
    PidSetting("#2", 3, _S3_POSITION, _S3_VELOCITY, Terms(0.12, 0.0008, 0.2)),
    PidSetting("#3", 3, _S3_POSITION, _S3_VELOCITY, Terms(0.07, 0.0, 0.02)),
    PidSetting("#4", 4, Terms(29.0, 0.0, 5.0), Terms(0.1864, 0.0, 0.1), Terms(0.2796, 0.0, 0.9321)),
    PidSetting("#5", 4, Terms(15.0, 0.001, 4.0), Terms(3.1864, 0.0, 2.1), Terms(5.12, 0.01, 2.3321)),
    PidSetting("#6", 4, Terms(21.0, 0.0, 3.0), Terms(3.1864, 1.0, 2.1), Terms(0.3, 0.0, 1.6321)),
)


def setting(name: str) -> PidSetting:
    """Look up a setting by the thesis' name for it.

    Raises:
        UsageError: there is no such setting; the message lists those that there are.
    """
    for each in SETTINGS:
        if each.name == name:
            return each
    raise UsageError(f"no PID setting {name!r}; the thesis has {', '.join(s.name for s in SETTINGS)}")


def thesis_gains(kind: ModuleType, chosen: PidSetting, reading: Reading) -> GainSet:
    """Return a setting as gains of this firmware; gains that the thesis does not print are the factory's."""
    factory = default_gains(kind, chosen.strategy)
    return factory.model_copy(
        update={
            "position": _loop(factory.position, chosen.position, reading),
            "velocity": _loop(factory.velocity, chosen.velocity, reading),
            "effort": _loop(factory.effort, chosen.effort, reading),
        }
    )


def without_velocity(gains: GainSet) -> GainSet:
    """Return gains under which a velocity set-point has no effect: the thesis' input mode 1."""
    silent = gains.velocity.model_copy(
        update={"kp": 0.0, "ki": 0.0, "kd": 0.0, "feed_forward": 0.0, "punch": 0.0}
    )
    return gains.model_copy(update={"velocity": silent})


def _loop(factory: PidGains, terms: Terms, reading: Reading) -> PidGains:
    per_s = TICK_S if reading == "per tick" else 1.0
    return factory.model_copy(update={"kp": terms.kp, "ki": terms.ki / per_s, "kd": terms.kd * per_s})
