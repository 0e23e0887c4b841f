"""`x5-sim effects`: the table of effects, also as the page `docs/effects.md`."""

from collections.abc import Iterable
from typing import Annotated

import typer

from coordinator.commands.options import JsonFile
from coordinator.runtime.terminal import new_table, print_table, write_result
from module_agent.model.catalogue import module_type
from module_agent.network_emulation.profile import PROFILES
from sim.actuator.actuator import BUS_VOLTAGE_V, SPRING_LOSS_S, STOP_NM_RAD
from sim.imperfections.effects import EFFECTS, Effect
from sim.imperfections.noise_profile import DEFAULT_PROFILE, NOISE_PROFILES, NoiseProfile

# How a field's name ends, the unit of its number, and whether small numbers are shown in thousandths of it.
_UNITS = (
    ("_s_m", "rad/s per m/s²", True),
    ("_m_s2", "m/s²", True),
    ("_rad_s", "rad/s", True),
    ("_rad", "rad", True),
    ("_hz", "Hz", False),
    ("_ppm", "ppm", False),
    ("_s", "s", True),
    ("_m", "m", True),
    ("_mass", "%", False),
    ("_fraction", "% of the largest", False),
    ("_spread", "%", False),
    ("_scale", "%", False),
)
OFF = "off"

_HEAD = f"""# Imperfections of the simulated module

Every effect can be switched on its own: `--with NAME` and `--without NAME` of `x5-sim run` and
`world`. A noise profile (`--noise`) is a set of them: `ideal` has perfect sensors on a rigid robot, `x5` is a
module with a calibrated IMU, `{DEFAULT_PROFILE}` (the default) one as delivered, `poor` has all of them, and
larger ones. Sizes are one standard deviation where they differ between modules or samples, unless the model
says otherwise; they are drawn once per module from the seed. The default size is that of `x5-uncalibrated`; a
profile with another one has it in brackets. The network is chosen by
`--network NAME|FILE`, the robot's structure is in its file. `x5-sim effects` prints the same table.

"""


def effects(
    json_file: JsonFile = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print a page of Markdown.")] = False,
) -> None:
    """List the imperfections of a simulated module, which `--with` and `--without` switch."""
    if markdown:
        typer.echo(page(), nl=False)
        return
    rows = [effect._asdict() | {"profiles": profiles_with(effect)} for effect in EFFECTS.values()]
    if write_result(json_file, rows):
        table = new_table(None, "effect | part | model | size | in the profiles", show_lines=True)
        for name, effect in EFFECTS.items():
            table.add_row(name, effect.part, effect.model, default_size(effect), profiles_and_sizes(effect))
        print_table(table)


def page() -> str:
    """Return the whole page, one table per part of a module, rows in the order of `EFFECTS`."""
    parts = dict.fromkeys(effect.part for effect in EFFECTS.values())
    return _HEAD + "\n".join([*(_table(part) for part in parts), _always(), _network()])


def sizes(effect: Effect, profile: NoiseProfile) -> str:
    """Return an effect's sizes in a profile with their units, or "off"."""
    shown = {field: getattr(profile, field) for field in effect.sizes}
    return ", ".join(_size(field, value) for field, value in shown.items()) if any(shown.values()) else OFF


def profiles_with(effect: Effect) -> list[str]:
    """Return the names of the profiles that have an effect."""
    return [name for name, profile in NOISE_PROFILES.items() if sizes(effect, profile) != OFF]


def profiles_and_sizes(effect: Effect) -> str:
    """Return the names of the profiles that have an effect, each with its sizes if they are others."""
    each = {name: sizes(effect, NOISE_PROFILES[name]) for name in profiles_with(effect)}
    usual = usual_size(effect)
    return ", ".join(name if size == usual else f"{name} ({size})" for name, size in each.items())


def _always() -> str:
    rotor = module_type("X5-1").motor.rotor_inertia_kg_m2
    rows = (
        f"reflected inertia | the rotor's, times the gear ratio squared | {rotor:.2g} kg m² at the rotor | "
        "real X5-1 log: the first step",
        f"spring loss | damping over stiffness of the spring | {1e3 * SPRING_LOSS_S:g} ms | an assumption: "
        "rubber's loss factor of 0.1 at 5 Hz, chosen so that light arms ring as little as the thesis' did; "
        "with a third of it their estimated lengths are 10 % longer",
        f"end stops | stiff and lossy, where a type's rotation is limited | {STOP_NM_RAD:g} Nm/rad | "
        "an assumption",
        f"voltage and PWM limits | duty = u x 48 V / bus voltage, cut off at 1 | {BUS_VOLTAGE_V:g} V | "
        "real X5-1 log",
        "winding's PWM ceiling | in the firmware: 1 - 1 / (155 - temperature) | 0.9923 at 25 °C | "
        "published; real X5-1 log: 0.9636 at 127.6 °C",
        "velocity cut-off | in the firmware: the velocity target is clamped | "
        "by type: 9.62, 3.43, 1.50 rad/s | published gains",
    )
    return _section("Always there", "effect | model | size | source", rows)


def _network() -> str:
    lan, wifi = PROFILES["lan"], PROFILES["wifi"]
    up, burst, stall = wifi.path("coordinator"), wifi.loss_burst, wifi.stall
    assert burst is not None
    assert stall is not None
    rows = (
        "delay and jitter | minimum delay plus a gamma, lognormal or Pareto variate; order preserved as by "
        f"one TCP link | {lan.delay_ms:g} ms and {lan.jitter_ms:g} ms (`lan`); {wifi.delay_ms:g} ms and "
        f"{wifi.jitter_ms:g} ms (`wifi`) | real X5-1: round trip 0.70 ms; `wifi`: Huitema 2023",
        f"loss in bursts | Gilbert-Elliott channel in continuous time | `wifi`: {wifi.loss:.1%}; "
        f"{burst.loss:.0%} for {burst.mean_ms:g} ms every {burst.apart_s:g} s | "
        "Gilbert 1960, Elliott 1963; sizes: a busy room",
        "stalls | nothing passes for a while, then all waiting messages | "
        f"`wifi`: {stall.mean_ms:g} ms every {stall.apart_s:g} s | Huitema 2023: latency spikes of Wi-Fi",
        f"asymmetry | another path in each direction | `wifi`: jitter {wifi.jitter_ms:g} ms down, "
        f"{up.jitter_ms:g} ms up; see `asymmetric` | stations contend for the channel, the access point has "
        "it more often",
        "reordering and duplication | a message overtakes, or arrives twice | "
        f"`wifi`: {wifi.reorder:.1%} and {wifi.duplicate:.1%} | an assumption: residue of retransmission "
        "below the transport",
        "partition | nothing passes in given intervals | off; in a network file | chosen by the user",
        "recorded trace | delays and losses as measured, repeated | off; in a network file | `ping -D -O`",
    )
    columns = "effect | model | size | source | switch"
    return _section("Network", columns, [f"{row} | `--network`" for row in rows])


def _section(title: str, columns: str, rows: Iterable[str]) -> str:
    """Return a heading and a table; cells are separated by bars."""
    ruler = "---|" * len(columns.split(" | "))
    return "\n".join([f"## {title}", "", f"| {columns} |", f"|{ruler}", *(f"| {row} |" for row in rows), ""])


def default_size(effect: Effect) -> str:
    """Return an effect's sizes in the default profile; where it is off there, those that the switch gives."""
    is_on = sizes(effect, NOISE_PROFILES[DEFAULT_PROFILE]) != OFF
    return usual_size(effect) if is_on else f"{OFF}; switched on: {usual_size(effect)}"


def usual_size(effect: Effect) -> str:
    """Return an effect's sizes in the default profile with the effect."""
    profile = NOISE_PROFILES[DEFAULT_PROFILE]
    size = sizes(effect, profile)
    return size if size != OFF else sizes(effect, profile.model_copy(update=dict(effect.sizes)))


def _table(part: str) -> str:
    rows = []
    for name, effect in EFFECTS.items():
        if effect.part == part:
            title, where = name.replace("-", " ").replace("imu", "IMU"), profiles_and_sizes(effect)
            cells = (title, effect.model, default_size(effect), where, effect.source, f"`{name}`")
            rows.append(" | ".join(cells))
    columns = "effect | model | default size | profiles | source | switch"
    return _section(f"{part[0].upper()}{part[1:]}", columns, rows)


def _size(field: str, value: float) -> str:
    for ending, unit, small in _UNITS:
        if field.endswith(ending):
            name = field.removesuffix(ending).replace("_", " ")
            if unit.startswith("%"):
                return f"{name} {100.0 * value:.3g} {unit}"
            shown = f"{1e3 * value:.3g} m" if small and value < 0.1 else f"{value:.3g} "
            return f"{name} {shown}{unit}"
    return "as described" if value == 1.0 else f"{value:.3g} times as described"
