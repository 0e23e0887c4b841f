"""The table of effects: every size has a switch, a profile and a line in the page that people read."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from module_agent.hardware.hardware import SensorSample
from sim.commands.effects_page import page
from sim.imperfections.effects import EFFECTS
from sim.imperfections.noise_profile import (
    DEFAULT_PROFILE,
    NOISE_PROFILES,
    NoiseProfile,
    noise_profile,
    switched,
)
from sim.main import app
from sim.robot.robot_file import parse_robot
from sim.world.world import World

_FLAIL = """
name = "flail"
[base]
mount = "wall"
[base.compliance]
mass_kg = 1.0
inertia = [1e-2, 1e-2, 1e-2, 0.0, 0.0, 0.0]
stiffness_nm_rad = [500.0, 500.0, 500.0]
[[module]]
serial = "A"
type = "X5-1"
parent = "base"
[[module]]
serial = "B"
type = "X5-1"
parent = "A"
link = { tube = { length_m = 0.4, twist_rad = 0.0 } }
"""
PAGE = Path(__file__).parents[3] / "docs" / "effects.md"


def test_every_size_of_a_profile_belongs_to_one_effect() -> None:
    fields = [field for effect in EFFECTS.values() for field in effect.sizes]
    assert sorted(fields) == sorted(set(NoiseProfile.model_fields) - {"name"})


def test_every_effect_has_a_size_and_tells_its_source() -> None:
    for effect in EFFECTS.values():
        assert all(size > 0.0 for size in effect.sizes.values()), effect.name
        assert len(effect.source) > 10, effect.name


def test_the_page_is_what_the_program_prints() -> None:
    # Write it again with: x5-sim effects --markdown > docs/effects.md
    assert PAGE.read_text(encoding="utf-8") == page()
    assert CliRunner().invoke(app, ["effects", "--markdown"]).output == page()


def test_the_default_profile_is_an_uncalibrated_imu() -> None:
    profile = noise_profile(DEFAULT_PROFILE)
    assert profile.accel_scale == 0.01
    assert profile.imu_misalignment_rad == pytest.approx(0.01745, abs=1e-5)
    assert profile.accel_bias_m_s2 == pytest.approx(0.196, abs=1e-3)
    assert noise_profile("x5").accel_scale == noise_profile("x5").imu_misalignment_rad == 0.0


def test_poor_has_everything_and_ideal_only_what_every_motor_has() -> None:
    assert all(v for k, v in NOISE_PROFILES["poor"].model_dump().items() if k != "name")
    named = {k for k, v in NOISE_PROFILES["ideal"].model_dump().items() if k != "name" and v}
    assert named == {"friction", "gear_loss", "heat"}


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_can_be_switched_alone(name: str) -> None:
    everything, ideal = NOISE_PROFILES["poor"], NOISE_PROFILES["ideal"]
    without, having = switched(everything, off=(name,)), switched(ideal, on=(name,))
    changed = {f for f in NoiseProfile.model_fields if getattr(without, f) != getattr(everything, f)}
    assert changed == set(EFFECTS[name].sizes)
    assert all(getattr(having, field) == size for field, size in EFFECTS[name].sizes.items())
    # And the modules feel it: the same seed and PWM give other readings.
    assert _violent(having) != _violent(switched(ideal, off=(name,)))


def _violent(profile: NoiseProfile) -> list[SensorSample]:
    """What a module thrown about at ten times its voltage reads; 8 g are reached at the light arm's end."""
    world = World(parse_robot(_FLAIL, "flail"), seed=1, noise=profile, voltage_v=240.0)
    samples = [s for k in range(400) for s in world.step([0.02 if k < 200 else -1.0, 0.0])]
    world.close()
    return samples


def test_an_effect_that_is_on_keeps_its_size() -> None:
    assert switched(NOISE_PROFILES["poor"], on=("imu-scale",)).accel_scale == 0.03


def test_effects_are_listed_for_programs_too() -> None:
    rows = json.loads(CliRunner().invoke(app, ["effects", "--json", "-"]).output)
    assert [row["name"] for row in rows] == list(EFFECTS)
    assert next(row for row in rows if row["name"] == "backlash")["profiles"] == ["poor"]
