"""The thesis' one-joint arms and what it measured on them: chapter 6.2, tables 4 and 5."""

from typing import Literal, NamedTuple

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
    """Look up what the thesis found for an arm.

    Raises:
        KeyError: the thesis had no such arm; the message lists its lengths.
    """
    for found in THESIS_LENGTHS:
        if (found.alignment, found.length_mm) == (alignment, length_mm):
            return found
    raise KeyError(
        f"the thesis had no {alignment} arm of {length_mm} mm; its lengths are "
        f"{', '.join(map(str, LENGTHS_MM))} mm"
    )
