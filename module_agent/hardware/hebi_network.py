"""HEBI modules on the network: finding them, what they tell of themselves, and setting their limits."""

import math
import re
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from module_agent.control.gains import catalogue_limits, default_gains, for_message
from module_agent.control.safety import UNCONFIGURED, LimitAction, MStopAction, Safety
from module_agent.control.safety_file import XML_FIELDS, read_safety
from module_agent.hardware.hardware import HardwareLost, ModuleInformation
from module_agent.hardware.hebi_library import HEBI, Group, Library, library, names_of
from module_agent.hardware.hebi_modules import HebiModules
from module_agent.hardware.loop_inside import DEFAULT_STRATEGY
from module_agent.model.catalogue import CATALOGUE, ModuleType, module_type
from module_agent.model.errors import UsageError
from module_agent.wire.keys import check_chunk
from module_agent.wire.messages import GainSet, Limits, PidGains

# Modules answer the lookup within a second; HEBI's examples wait for two.
LOOKUP_S = 2.0
MIN_RATE_HZ, MAX_RATE_HZ = 50.0, 1000.0
_TIMEOUT_MS = 1000
# HEBI's values of what happens at a limit of position, and while the emergency stop is pressed.
AT_LIMIT: dict[LimitAction, int] = {"hold": 0, "spring": 1, "motor_off": 2, "disabled": 3}
AT_M_STOP: dict[MStopAction, int] = {"disabled": 0, "motor_off": 1, "hold": 2}


# HEBI's own family, and as many ticks a second as `run` records by default.
FAMILY, RATE_HZ = "HEBI", 250.0


class HebiOptions(NamedTuple):
    """Which modules to drive and how: those of a family by their names, or all of them without.

    types: of the modules in their order, if they are not to be asked. safety: the file of their limits.
    `library` stands in for hebi-py.
    """

    family: str
    names: tuple[str, ...] = ()
    types: tuple[str, ...] = ()
    rate_hz: float = RATE_HZ
    safety: Path | None = None
    library: str = HEBI


def _no_note(text: str) -> None:
    """Say nothing."""


def open_modules(options: HebiOptions, note: Callable[[str], None] = _no_note) -> HebiModules:
    """Find modules on the network and return their driver, in real time; see `describe` for notes.

    Raises:
        UsageError: hebi-py or a module is missing, or an option or a limit cannot be.
        HardwareLost: a module does not answer, or does not take its limits.
    """
    hebi = library(options.library)
    group = find_group(hebi, options.family, options.names)
    information = describe(hebi, group, options.rate_hz, options.types, note)
    if options.safety is not None:
        limits = read_safety(options.safety, [module.serial for module in information])
        information = restrict(hebi, group, information, list(limits.values()))
    return HebiModules(hebi, group, information, Pace(options.rate_hz).wait)


class Seen(NamedTuple):
    """A module on the network; serial, type and firmware are empty if it does not tell them."""

    family: str
    name: str
    address: str
    serial: str
    mechanical_type: str
    firmware: str


def seen(hebi: Library, sleep: Callable[[float], None] = time.sleep) -> list[Seen]:
    """Return the modules that answer a lookup, by family and name."""
    lookup = hebi.Lookup()
    sleep(LOOKUP_S)
    entries = [entry for entry in lookup.entrylist if entry is not None]
    found = []
    for entry in sorted(entries, key=lambda e: (e.family, e.name)):
        group = lookup.get_group_from_names([entry.family], [entry.name], _TIMEOUT_MS)
        info = None if group is None else group.request_info(timeout_ms=_TIMEOUT_MS)
        told = [""] * 3
        if info is not None:
            told = names_of([info.serial[0], info.mechanical_type[0], info.firmware_revision[0]])
        found.append(Seen(entry.family, entry.name, str(entry.ip_address), *told))
    return found


def find_group(
    hebi: Library, family: str, names: Sequence[str], sleep: Callable[[float], None] = time.sleep
) -> Group:
    """Return the modules of a family by their names, or all of them without names.

    Raises:
        UsageError: one is missing; the message has those that are there.
    """
    lookup = hebi.Lookup()
    sleep(LOOKUP_S)
    if names:
        group = lookup.get_group_from_names([family], list(names), _TIMEOUT_MS)
    else:
        group = lookup.get_group_from_family(family, _TIMEOUT_MS)
    if group is None:
        there = sorted(f"{e.family}/{e.name}" for e in lookup.entrylist if e is not None)
        wanted = ", ".join(f"{family}/{name}" for name in names) or f"any module of family {family}"
        raise UsageError(
            f"{wanted}: not all are on the network, which has {', '.join(there) or 'none'} "
            "(see x5-agent --hebi --list)"
        )
    return group


def describe(
    hebi: Library,
    group: Group,
    rate_hz: float,
    types: Sequence[str] = (),
    note: Callable[[str], None] = _no_note,
) -> list[ModuleInformation]:
    """Return what the modules of a group tell of themselves: their own gains and limits among it.

    Accelerometers are made to read specific force: the setting is not saved in the module.

    Args:
        hebi: hebi-py.
        group: the modules.
        rate_hz: ticks a second.
        types: of the modules in their order, if they are not to be asked.
        note: is told which gains a module does not tell, and gets from the factory.

    Raises:
        HardwareLost: they do not answer, or an accelerometer cannot be made to read gravity.
        UsageError: a rate, a number of types, a type or a serial that cannot be.
    """
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise UsageError(f"--rate {rate_hz:g}: it must be {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} Hz")
    if types and len(types) != group.size:
        raise UsageError(f"{len(types)} types for {group.size} modules: give one for each, or none")
    info = _info(group)
    if not info.accel_includes_gravity.all():
        info = _with_gravity(hebi, group)
    return [_described(info, index, rate_hz, types, note) for index in range(group.size)]


def _info(group: Group) -> Any:
    info = group.request_info(timeout_ms=_TIMEOUT_MS)
    if info is None:
        raise HardwareLost(f"a module does not tell its settings within {_TIMEOUT_MS} ms")
    return info


def _with_gravity(hebi: Library, group: Group) -> Any:
    command = hebi.GroupCommand(group.size)
    command.accel_includes_gravity = [True] * group.size
    group.send_command_with_acknowledgement(command, timeout_ms=_TIMEOUT_MS)
    info = _info(group)
    wrong = [name for name, on in zip(info.serial, info.accel_includes_gravity, strict=True) if not on]
    if wrong:
        raise HardwareLost(
            f"the accelerometer of {', '.join(names_of(wrong))} leaves out gravity (accel_includes_gravity) "
            "and does not take the setting: every estimate needs specific force; set it in HEBI's Scope"
        )
    return info


def _described(
    info: Any, index: int, rate_hz: float, types: Sequence[str], note: Callable[[str], None]
) -> ModuleInformation:
    name, family, serial = (names_of(values)[index] for values in (info.name, info.family, info.serial))
    check_chunk("serial", serial)
    told = types[index] if types else names_of(info.mechanical_type)[index]
    kind = module_type(_type_name(told, serial))
    tick_ns = round(1e9 / rate_hz)
    gains, from_factory = _gains(info, index, kind)
    if from_factory:
        note(f"module {serial} {from_factory}")
    limits, safety = _limits(info, index, kind)
    return ModuleInformation(serial, name, family, kind.name, gains, limits, tick_ns, tick_ns, safety)


def restrict(
    hebi: Library, group: Group, information: Sequence[ModuleInformation], safety: Sequence[Safety]
) -> list[ModuleInformation]:
    """Set the limits of modules until their next power cycle; return what the modules are now.

    A limit that a module has and that is narrower than the configured one stays.

    Args:
        hebi: hebi-py.
        group: the modules.
        information: what they tell, in their order.
        safety: their limits, in their order.

    Raises:
        UsageError: a limit that HEBI's modules do not have, or one that leaves no position.
        HardwareLost: a module does not take its limits.
    """
    for module, one in zip(information, safety, strict=True):
        others = [key for key, value in one if key not in XML_FIELDS and value != getattr(UNCONFIGURED, key)]
        if others:
            raise UsageError(f"module {module.serial}: a real module has no limit {', '.join(others)}")
    limits = [one.tightened(module.limits) for module, one in zip(information, safety, strict=True)]
    command = hebi.GroupCommand(group.size)
    written = [
        dict(_settings(one, own, module.limits))
        for module, one, own in zip(information, safety, limits, strict=True)
    ]
    for index, settings in enumerate(written):
        for name, value in settings.items():
            setattr(command[index], name, value)
    group.send_command_with_acknowledgement(command, timeout_ms=_TIMEOUT_MS)
    info = _info(group)
    for index, (module, settings) in enumerate(zip(information, written, strict=True)):
        for name, value in settings.items():
            # Speeds and torques are of single precision.
            if not math.isclose(told := float(getattr(info, name)[index]), value, rel_tol=1e-6):
                raise HardwareLost(f"module {module.serial} does not take {name} {value:g}, it has {told:g}")
    return [
        module._replace(limits=own, safety=_in_force(one, own, module.safety))
        for module, one, own in zip(information, safety, limits, strict=True)
    ]


def _in_force(safety: Safety, limits: Limits, before: Safety) -> Safety:
    """Return a configuration with what happens at each limit: at a narrower one of its own, as before."""
    own = limits.min_position_rad, limits.max_position_rad
    sides = zip(safety.range_rad, own, safety.at_limit, before.at_limit, strict=True)
    at_limit = tuple(action if limit == tight else kept for limit, tight, action, kept in sides)
    return safety.model_copy(update={"at_limit": at_limit})


def _settings(safety: Safety, limits: Limits, before: Limits) -> Iterator[tuple[str, float]]:
    """Yield HEBI's names and values of the limits of a module that are narrower than its own.

    limits: the module's, tightened by `safety`; before: as the module has them.
    """
    own = limits.min_position_rad, limits.max_position_rad
    for side, limit, action, tight in zip(
        ("min", "max"), safety.range_rad, safety.at_limit, own, strict=True
    ):
        if limit == tight:
            yield f"position_limit_{side}", limit
            yield f"{side}_position_limit_strategy", AT_LIMIT[action]
    for name, both, most in (
        ("velocity", safety.velocity_rad_s, before.max_speed_rad_s),
        ("effort", safety.effort_nm, before.max_effort_nm),
    ):
        for side, limit in zip(("min", "max"), both, strict=True):
            if math.isfinite(limit):
                yield f"{name}_limit_{side}", math.copysign(min(abs(limit), most), limit)
    if safety.m_stop is not None:
        yield "mstop_strategy", AT_M_STOP[safety.m_stop]


def _type_name(told: str, serial: str) -> str:
    """Return the catalogue's name of what a module says that it is, such as "X5-4" or "Actuator X5-4 B"."""
    # "X5-9-old" is no X5-9.
    for name in sorted(CATALOGUE, key=len, reverse=True):
        if re.search(rf"(?<![\w-]){re.escape(name)}(?!\d)", told):
            return name
    raise UsageError(
        f"module {serial} is of type {told!r}; the catalogue knows {', '.join(CATALOGUE)}: give --type for "
        "every module, or add its type to module_types.toml"
    )


def _limits(info: Any, index: int, kind: ModuleType) -> tuple[Limits, Safety]:
    """Return the type's limits, or the module's own where they are narrower, and what happens at its own."""
    limits = catalogue_limits(kind)
    sides = [(side, float(getattr(info, f"position_limit_{side}")[index])) for side in ("min", "max")]
    position, at_limit = {}, list(UNCONFIGURED.at_limit)
    # One that a module does not tell is NaN.
    if not sides[0][1] >= sides[1][1]:
        for place, (side, limit) in enumerate(sides):
            action = getattr(info, f"{side}_position_limit_strategy")[index]
            if action != AT_LIMIT["disabled"] and math.isfinite(limit):
                position[f"{side}_position_rad"] = limit
                if action == AT_LIMIT["motor_off"]:
                    at_limit[place] = "motor_off"
    most = {}
    for field, name in (("max_speed_rad_s", "velocity"), ("max_effort_nm", "effort")):
        own = (abs(float(getattr(info, f"{name}_limit_{side}")[index])) for side in ("min", "max"))
        most[field] = min([getattr(limits, field), *(value for value in own if value > 0.0)])
    return limits.model_copy(update=position | most), UNCONFIGURED.model_copy(
        update={"at_limit": tuple(at_limit)}
    )


def _gains(info: Any, index: int, kind: ModuleType) -> tuple[GainSet, str]:
    """Return the gains that a module has, and which are the factory's as it does not tell them, "" if none.

    Strategy 0 is what an M-stop leaves behind, and what hebi-py reads where a module tells none: which
    strategy its gains are for is not known then.
    """
    strategy = int(info.control_strategy[index])
    if strategy not in range(1, 5):
        return default_gains(kind, DEFAULT_STRATEGY), (
            f"has control strategy {strategy}, as after an M-stop: with its first lease it gets the factory "
            f"gains of its type for strategy {DEFAULT_STRATEGY}, in place of its owner's"
        )
    factory = default_gains(kind, strategy)
    loops, unknown = {}, []
    for loop in ("position", "velocity", "effort"):
        told = {name: _told_gain(getattr(info, f"{loop}_{name}")[index]) for name in PidGains.model_fields}
        known = {name: value for name, value in told.items() if value is not None}
        try:
            loops[loop] = PidGains.model_validate(getattr(factory, loop).model_dump() | known)
            unknown += [f"{loop}_{name}" for name in told if name not in known]
        except ValidationError:
            loops[loop] = getattr(factory, loop)
            unknown.append(f"{loop}_*")
    used = f"does not tell {', '.join(unknown)}: with its first lease it gets the factory's"
    return GainSet(strategy=strategy, **loops), used if unknown else ""


def _told_gain(value: Any) -> float | bool | None:
    """Return one gain of an information message; None for what a module does not tell."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    # Of single precision: 0.1 is 0.1 and not 0.100000001.
    return None if math.isnan(value) else for_message(float(str(value)))


class Pace:
    """Returns from `wait` at even times; a tick that comes late is not made up for."""

    def __init__(
        self,
        rate_hz: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._period_s = 1.0 / rate_hz
        self._clock, self._sleep = clock, sleep
        self._due_s = clock()

    def wait(self) -> None:
        """Sleep until the next tick is due."""
        now_s = self._clock()
        if now_s < self._due_s:
            self._sleep(self._due_s - now_s)
            self._due_s += self._period_s
        else:
            self._due_s = max(self._due_s, now_s - self._period_s) + self._period_s
