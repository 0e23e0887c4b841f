"""The motions of a plan are the thesis', within the limits of every module type."""

import re
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from coordinator.excitation.plan import Plan, load_plan
from module_agent.control.gains import catalogue_limits, default_gains
from module_agent.control.motion import Motion, check_motion
from module_agent.control.waveform import duration_s
from module_agent.model.catalogue import CATALOGUE, ModuleType
from module_agent.model.errors import UsageError

TYPES = list(CATALOGUE.values())
TICK_NS = 1_000_000


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.name)
def test_every_motion_is_within_what_the_firmware_accepts(kind: ModuleType) -> None:
    plan = Plan()
    for pattern in (plan.constant(), plan.sine(kind), plan.dynamic(kind), plan.held_out(kind)):
        motion = Motion(pattern, 0.0, 0)
        check_motion(motion, catalogue_limits(kind))
        assert motion.top_speed_rad_s < kind.max_speed_rad_s


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.name)
def test_peak_speeds_leave_the_motor_a_quarter_of_its_own(kind: ModuleType) -> None:
    plan = Plan()
    for pattern in (plan.sine(kind), plan.dynamic(kind), plan.held_out(kind)):
        motion = Motion(pattern, 0.0, 0)
        ticks = np.arange(0, int(duration_s(pattern, 0.0) * 1e9), TICK_NS)
        commands = [motion.command(int(t)) for t in ticks]
        speeds = [abs(c.velocity_rad_s or 0.0) for c in commands if c is not None]
        assert max(speeds) < 0.75 * kind.max_speed_rad_s


def test_defaults_are_those_of_the_thesis() -> None:
    plan = Plan()
    constant, sine = plan.constant(), plan.sine(CATALOGUE["X5-4"])
    assert (constant.velocity_rad_s, constant.duration_s) == (1.0, 0.75)  # section 6.2.1.1
    assert (sine.frequency_hz, sine.centre_s, sine.sigma_s) == (2.0, 2.8, 1.0)  # table 3


def test_the_held_out_motion_is_another_than_the_fitted_one() -> None:
    kind = CATALOGUE["X5-4"]
    fitted, held_out = Plan().dynamic(kind), Plan().held_out(kind)
    assert fitted.frequency_hz != held_out.frequency_hz
    assert fitted.amplitude_rad != held_out.amplitude_rad


def test_a_set_amplitude_is_taken_as_it_is() -> None:
    for kind in TYPES:
        assert Plan(sine_amplitude_rad=0.05).sine(kind).amplitude == 0.05
        assert Plan(dynamic_amplitude_rad=0.2).dynamic(kind).amplitude_rad == 0.2


def test_exploring_gains_stiffen_the_position_loop_alone() -> None:
    kind = CATALOGUE["X5-9"]
    default = default_gains(kind, 3)
    stiff = Plan(hold_stiffness=4.0).exploring_gains(kind, 3)
    assert stiff.position.kp == 4.0 * default.position.kp
    assert stiff.model_copy(update={"position": default.position}) == default
    assert Plan().exploring_gains(kind, 3) == default


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rest_s", 0.0),
        ("rest_s", float("nan")),
        ("sine_frequency_hz", -2.0),
        ("retries", 6),
        ("colour", 1),
        ("home_rad", 99.0),
    ],
)
def test_impossible_plans_are_refused_by_field(field: str, value: float) -> None:
    with pytest.raises(ValidationError, match=field):
        Plan.model_validate({field: value})


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("colour = 1", "plan.toml:2: colour: unknown setting; known are mode, motions, "),
        ("retries = 6", "plan.toml:2: retries: expected at most 5, found 6"),
        ("mode = 'half'", "plan.toml:2: mode: expected 'joint' or 'simultaneous', found 'half'"),
    ],
)
def test_a_file_that_is_no_plan_is_refused_with_line_and_setting(
    tmp_path: Path, line: str, words: str
) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(f"rest_s = 1.0\n{line}\n")
    with pytest.raises(UsageError, match=re.escape(words)):
        load_plan(path)


def test_all_that_is_wrong_with_a_plan_is_said_at_once(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text("rest_s = -1.0\nretries = 6\ncolour = 1\n")
    with pytest.raises(UsageError) as refused:
        load_plan(path)
    lines = str(refused.value).splitlines()
    assert [line.split(": ")[1] for line in lines] == ["rest_s", "retries", "colour"]
    assert [line.split(":")[1] for line in lines] == ["1", "2", "3"]


@pytest.mark.parametrize(("field", "value"), [("mode", "half"), ("motions", "best"), ("precision_mm", 0.0)])
def test_modes_and_motions_that_there_are_not_are_refused_by_field(field: str, value: object) -> None:
    with pytest.raises(ValidationError, match=field):
        Plan.model_validate({field: value})
