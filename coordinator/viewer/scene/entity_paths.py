"""Where everything is in a recording: the timeline, the entity paths and the colours.

/world/{est,true}/...           the robot as identified and, from the simulator's tools, as it is
/modules/<serial>/<group>       one vector entity per group of sensors
/estimates/<parameter>/<serial> value with variance; below it the 95 % interval and, if known, the true value
/residuals/<serial>/...         held-out torque, measured and predicted
/network/<serial>/...           round trip, age of the newest sample, refusals
/topology, /phase/...           the tree of modules; the steps of the run
/result                         the tables of the result
"""

import colorsys
from functools import partial
from typing import Final

APPLICATION_ID: Final = "x5"
TIMELINE: Final = "session_time"

Colour = tuple[int, int, int, int]

ESTIMATE_COLOUR: Final[Colour] = (255, 150, 40, 150)
PREDICTION_COLOUR: Final[Colour] = (255, 150, 40, 255)
TRUTH_COLOUR: Final[Colour] = (165, 165, 170, 255)
# Translucent in 3D, so that it does not hide the estimate, which should coincide with it.
TRUE_BODY_COLOUR: Final[Colour] = (190, 190, 195, 110)
COMMAND_COLOUR: Final[Colour] = (225, 225, 225, 255)

# Far apart in hue and light enough for the dark background; orange is for estimates, grey for the truth.
_FIRST_COLOURS: Final[tuple[Colour, ...]] = (
    (86, 180, 233, 255),
    (80, 200, 120, 255),
    (230, 110, 190, 255),
    (240, 228, 66, 255),
    (230, 80, 80, 255),
    (150, 120, 255, 255),
    (60, 220, 215, 255),
    (185, 135, 105, 255),
)
_GOLDEN_RATIO = 0.618033988749895

STATE_COLOURS: Final[dict[str, Colour]] = {
    "idle": (95, 95, 105, 255),
    "armed": (70, 120, 190, 255),
    "moving": (70, 170, 100, 255),
    "streaming": (60, 180, 180, 255),
    "expired": (220, 170, 50, 255),
    "stopped": (190, 100, 60, 255),
    "fault": (220, 60, 60, 255),
}

ESTIMATED_WORLD: Final = "/world/est"
TRUE_WORLD: Final = "/world/true"
GRAVITY: Final = "/world/gravity"
TOPOLOGY: Final = "/topology"
PHASE_LOG: Final = "/phase/log"
PHASE_NOW: Final = "/phase/now"
RESULT: Final = "/result"

GYRO, ACCEL = "gyro", "accel"
POSITION, VELOCITY, EFFORT = "position", "velocity", "effort"
POSITION_COMMAND, VELOCITY_COMMAND, EFFORT_COMMAND = "position_command", "velocity_command", "effort_command"
PWM, CURRENT, VOLTAGE, TEMPERATURE, STATE = "pwm", "current", "voltage", "temperature", "state"
HELD_OUT, ERROR = "torque", "error"
ROUND_TRIP, AGE, REFUSALS = "round_trip", "age", "refusals"


def _group_path(root: str, serial: str, group: str) -> str:
    return f"/{root}/{part(serial)}/{group}"


# Of a group of a module's sensors; of its held-out torque (`HELD_OUT`, residual `ERROR`); of its connection.
module_path, residual_path, network_path = (
    partial(_group_path, root) for root in ("modules", "residuals", "network")
)


def estimate_path(name: str, serial: str) -> str:
    """Return the entity of one estimated parameter of a module."""
    return f"/estimates/{part(name)}/{part(serial)}"


def interval_path(name: str, serial: str) -> str:
    """Return the entity of the 95 % interval of an estimated parameter: its two ends."""
    return f"{estimate_path(name, serial)}/interval"


def truth_path(name: str, serial: str) -> str:
    """Return the entity of a parameter's true value, which is known in simulations only."""
    return f"{estimate_path(name, serial)}/true"


def body_path(world: str, serial: str | None) -> str:
    """Return the entity that moves with the body of joint `serial` in a world; None is the base."""
    return f"{world}/base" if serial is None else f"{world}/body/{part(serial)}"


def part(name: str) -> str:
    """Escape a name so that it is one part of an entity path, whatever characters it has."""
    import rerun as rr  # here, so that those who only name a path do without

    return rr.escape_entity_path_part(name)


class Palette(dict[str, Colour]):
    """The colour of each module, the same in every view and for the whole run; a new one gets the next."""

    def __missing__(self, serial: str) -> Colour:
        return self.setdefault(serial, nth_colour(len(self)))


def nth_colour(index: int) -> Colour:
    """Return the colour of module number `index`; no hue is near that of the estimates."""
    if index < len(_FIRST_COLOURS):
        return _FIRST_COLOURS[index]
    # 0.16 to 1.0 leaves out red-orange to amber.
    hue = 0.16 + 0.84 * ((index * _GOLDEN_RATIO) % 1.0)
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.55, 0.95)
    return (round(255 * red), round(255 * green), round(255 * blue), 255)


def shade(colour: Colour, factor: float) -> Colour:
    """Return the colour darker (factor below 1) or mixed with white (factor between 1 and 2)."""
    if factor <= 1.0:
        red, green, blue = (round(factor * c) for c in colour[:3])
    else:
        red, green, blue = (round(c + (factor - 1.0) * (255 - c)) for c in colour[:3])
    return (red, green, blue, colour[3])


def axis_shades(colour: Colour) -> tuple[Colour, Colour, Colour]:
    """Return the colours of a module's x, y and z components: its own, a light one and a dark one."""
    return (colour, shade(colour, 1.65), shade(colour, 0.5))
