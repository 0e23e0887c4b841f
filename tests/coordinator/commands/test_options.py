"""Settings of a plan on a command line: they precede a file's, and are named as they were given."""

from pathlib import Path

import pytest

from coordinator.commands.options import PlanOptions
from module_agent.model.errors import UsageError


def test_options_take_precedence_over_the_plans_file(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text("sine_amplitude_rad = 0.2\nrest_s = 3.0\n")
    plan = PlanOptions(plan=path, amplitude=0.1, home=0.5).chosen()
    assert (plan.sine_amplitude_rad, plan.home_rad, plan.rest_s) == (0.1, 0.5, 3.0)


def test_every_option_out_of_range_is_named_as_it_was_given() -> None:
    with pytest.raises(UsageError) as refused:
        PlanOptions(amplitude=-1.0, home=99.0).chosen()
    assert str(refused.value).splitlines() == [
        "--home: expected at most 6.2832, found 99.0",
        "--amplitude: expected more than 0, found -1.0",
    ]
