"""Tables 1 to 3 of the thesis: its modules, the parameters of its windowed sine, and what is used here."""

import math
from functools import partial
from typing import Any, NamedTuple

from coordinator.report.document import Table
from module_agent.firmware.config import FirmwareConfig
from module_agent.model.catalogue import ModuleType, module_type
from module_agent.wire.messages import WindowedSine
from sim.thesis.experiment import Check, Column, Experiment, Findings

_RPM_PER_RAD_S = 30.0 / math.pi
# Published data of one module differ by as much from sheet to sheet.
_ALIKE = 0.05


class _Value(NamedTuple):
    """A value as printed, and as used."""

    name: str
    printed: float
    used: float

    @property
    def is_alike(self) -> bool:
        return abs(self.used - self.printed) <= _ALIKE * abs(self.printed)


class _Configuration(NamedTuple):
    """One table of values, and remarks on them."""

    number: int
    title: str
    finding: str
    values: tuple[_Value, ...]
    reading: tuple[str, ...]


def _edges_mm(kind: ModuleType) -> list[float]:
    """Return the edges of a housing, the longest last [mm]."""
    corners = zip(kind.housing_min_xyz, kind.housing_max_xyz, strict=True)
    return sorted(1e3 * (high - low) for low, high in corners)


def _configurations() -> tuple[_Configuration, ...]:
    snake, x5 = module_type("SEA-snake"), module_type("X5-9-old")
    sine = WindowedSine(amplitude=1.0)
    rows_hz = float(FirmwareConfig._field_defaults["feedback_rate_hz"])
    return (
        _Configuration(
            1,
            "modules of the SEA Snake",
            "The thesis introduces the modules of the SEA Snake; its experiments use those of the X5 series.",
            (
                _Value("diameter [mm]", 51.0, _edges_mm(snake)[0]),
                _Value("length [mm]", 64.0, _edges_mm(snake)[-1]),
                _Value("mass [g]", 205.0, 1e3 * snake.mass_kg),
                _Value("largest torque [Nm]", 7.0, snake.max_effort_nm),
            ),
            ("Currents are not in the catalogue: they follow from the motor's constants and its friction.",),
        ),
        _Configuration(
            2,
            "modules of the X5 series",
            "The thesis ran all its experiments with modules of the X5 series.",
            (
                *(
                    _Value(f"{name} [mm]", printed, used)
                    for name, printed, used in zip(
                        ("height", "width", "length"), (31.0, 73.0, 110.0), _edges_mm(x5), strict=True
                    )
                ),
                _Value("mass [g]", 306.0, 1e3 * x5.mass_kg),
                _Value("largest speed [rpm]", 14.0, _RPM_PER_RAD_S * x5.max_speed_rad_s),
                _Value("largest torque [Nm]", 13.0, x5.max_effort_nm),
            ),
            (
                "14 rpm and 13 Nm are those of the X5-9, whose mass its maker gives as 360 g; 306 g may be a "
                "transposition of digits. The catalogue's is used.",
                "Arms have an X5-9 of the first generation at the base and one of the present at the tip.",
            ),
        ),
        _Configuration(
            3,
            "parameters of the windowed sine",
            "The thesis identified its lengths with one windowed sine, whose values it found by trial.",
            (
                _Value("f [Hz]", 2.0, sine.frequency_hz),
                _Value("Tm [s]", 2.8, sine.centre_s),
                _Value("Tsigma [s]", 1.0, sine.sigma_s),
                _Value("time step [ms]", 4.0, 1e3 / rows_hz),
                _Value("duration [s]", 15.0, 2.0 * sine.centre_s),
            ),
            ("The window has ended after 2 Tm, where the motion ends here; 15 s are the thesis' time axis.",),
        ),
    )


def _examine(configuration: _Configuration, _: list[Any]) -> Findings:
    checks = [
        Check(f"{one.name}: {one.used:g}, printed {one.printed:g}", one.is_alike)
        for one in configuration.values
    ]
    table = Table(
        caption="As printed, and as used here.",
        columns=(Column(name="value"), Column(name="printed", form="g"), Column(name="used", form=".4g")),
        rows=tuple((one.name, one.printed, one.used) for one in configuration.values),
    )
    return Findings(checks, (table,), (), configuration.reading)


CONFIGURATION_EXPERIMENTS: tuple[Experiment, ...] = tuple(
    Experiment(
        f"table{one.number}",
        f"Table {one.number}: {one.title}",
        one.finding,
        lambda scope: (),
        partial(_examine, one),
    )
    for one in _configurations()
)
