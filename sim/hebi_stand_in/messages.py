"""Messages with the names, shapes and number formats of hebi-py's: one entry a module, NaN if not set."""

import math
from typing import Any

import numpy as np

from module_agent.wire.messages import PidGains

LOOPS = ("position", "velocity", "effort")
_GAINS = [f"{loop}_{name}" for loop in LOOPS for name in PidGains.model_fields if name != "d_on_error"]
_ON_ERROR = [f"{loop}_d_on_error" for loop in LOOPS]

_LIMITS = {
    **dict.fromkeys(["position_limit_min", "position_limit_max"], np.float64),
    **dict.fromkeys([f"{name}_limit_{side}" for name in LOOPS[1:] for side in ("min", "max")], np.float32),
    **dict.fromkeys(
        ["min_position_limit_strategy", "max_position_limit_strategy", "mstop_strategy"], np.int32
    ),
}
COMMAND = {
    "position": np.float64,
    **dict.fromkeys(["velocity", "effort", *_GAINS], np.float32),
    **dict.fromkeys([*_ON_ERROR, "accel_includes_gravity"], np.bool_),
    "control_strategy": np.int32,
    **_LIMITS,
}
FEEDBACK = {
    "position": np.float64,
    **dict.fromkeys(
        [
            *("velocity", "effort", "deflection", "deflection_velocity", "motor_velocity"),
            *("motor_winding_current", "motor_winding_temperature", "voltage", "pwm_command"),
        ],
        np.float32,
    ),
    "hardware_transmit_time_us": np.uint64,
    **dict.fromkeys(
        [
            *("mstop_state", "temperature_state", "command_lifetime_state"),
            *("position_limit_state", "velocity_limit_state", "effort_limit_state"),
        ],
        np.int32,
    ),
}
VECTORS = ("gyro", "accelerometer")
INFO = {
    **dict.fromkeys(_GAINS, np.float32),
    **dict.fromkeys([*_ON_ERROR, "accel_includes_gravity"], np.bool_),
    "control_strategy": np.int32,
    **_LIMITS,
}
TEXTS = ("name", "family", "serial", "mechanical_type", "firmware_revision")


class GroupMessage:
    """A message of n modules; a field that it does not have is an error, as in hebi-py."""

    def __init__(self, fields: dict[str, Any], number_of_modules: int):
        self.__dict__["_arrays"] = {name: blank(kind, number_of_modules) for name, kind in fields.items()}
        self.__dict__["written"] = set()

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["_arrays"][name]
        except KeyError:
            raise AttributeError(f"a message has no field {name}") from None

    def __setattr__(self, name: str, value: Any) -> None:
        getattr(self, name)[:] = value
        self.written.add(name)


class GroupCommand(GroupMessage):
    """A command of n modules."""

    def __init__(self, number_of_modules: int):
        super().__init__(COMMAND, number_of_modules)
        self.__dict__["leds"] = [Led() for _ in range(number_of_modules)]

    def __getitem__(self, index: int) -> "ModuleCommand":
        return ModuleCommand(self, index)


class ModuleCommand:
    """One module's part of a command."""

    _group: GroupCommand
    _index: int
    led: "Led"

    def __init__(self, group: GroupCommand, index: int):
        self.__dict__.update(_group=group, _index=index, led=group.leds[index])

    def __setattr__(self, name: str, value: Any) -> None:
        getattr(self._group, name)[self._index] = value
        self._group.written.add((name, self._index))


class Led:
    """A module's LED: None is what the module itself lets it show."""

    color: "Color | None" = None


class Color:
    """A colour, each part 0 to 255."""

    def __init__(self, r: int, g: int, b: int, a: int = 255):
        self.r, self.g, self.b, self.a = r, g, b, a


class GroupFeedback(GroupMessage):
    """Feedback of n modules."""

    def __init__(self, number_of_modules: int):
        super().__init__(FEEDBACK, number_of_modules)
        self._arrays.update({name: np.full((number_of_modules, 3), math.nan, np.float32) for name in VECTORS})


class GroupInfo(GroupMessage):
    """What n modules tell of themselves."""

    def __init__(self, number_of_modules: int):
        super().__init__(INFO, number_of_modules)
        self._arrays.update({name: [None] * number_of_modules for name in TEXTS})


def blank(kind: Any, size: int) -> Any:
    """Return an array of what is not set: NaN, and 0 where there is no NaN."""
    return np.full(size, math.nan if np.issubdtype(kind, np.floating) else 0, kind)
