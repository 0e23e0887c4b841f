"""Factory gains are the manufacturer's, and those of a holder are of a size that a controller could have."""

import math

import pytest

from module_agent.control.gains import (
    UNLIMITED,
    catalogue_limits,
    check_gains,
    default_gains,
    for_message,
    from_message,
)
from module_agent.model.catalogue import CATALOGUE
from module_agent.wire.messages import PidGains
from module_agent.wire.refusal import Refusal, WireError

KP = {
    "X5-1": {2: (5.0, 0.1, 0.25), 3: (0.5, 0.05, 0.25), 4: (15.0, 0.05, 0.25)},
    "X5-4": {2: (10.0, 0.2, 0.25), 3: (1.0, 0.05, 0.25), 4: (10.0, 0.05, 0.25)},
    "X5-9": {2: (15.0, 0.5, 0.25), 3: (1.5, 0.05, 0.25), 4: (15.0, 0.05, 0.25)},
}


@pytest.mark.parametrize("name", KP)
@pytest.mark.parametrize("strategy", range(5))
def test_factory_gains_are_the_published_ones(name: str, strategy: int) -> None:
    kind = CATALOGUE[name]
    gains = default_gains(kind, strategy)
    kp = KP[name].get(strategy, KP[name][3])
    effort, speed = kind.max_effort_nm, kind.velocity_clamp_rad_s
    # Position outputs Nm under strategies 2 and 4, velocity under 2; PWM else.
    in_nm = {2: (effort, effort), 4: (effort, 1.0)}.get(strategy, (1.0, 1.0))
    assert gains.strategy == strategy
    assert gains.position == PidGains(kp=kp[0], min_output=-in_nm[0], max_output=in_nm[0])
    assert gains.velocity == PidGains(
        kp=kp[1],
        feed_forward=0.0 if strategy == 2 else 1.0,
        min_target=-speed,
        max_target=speed,
        min_output=-in_nm[1],
        max_output=in_nm[1],
        output_lowpass=0.75,
    )
    assert gains.effort == PidGains(
        kp=kp[2],
        kd=0.001,
        feed_forward=1.0,
        min_target=-1.6 * effort,
        max_target=1.6 * effort,
        output_lowpass=0.9,
        d_on_error=False,
    )


LIMITS = ("i_clamp", "min_output", "max_output")


@pytest.mark.parametrize("loop", ["position", "velocity", "effort"])
@pytest.mark.parametrize(
    ("field", "most"),
    [
        *(
            (name, 1e3)
            for name in ("kp", "kd", "feed_forward", "punch", "i_clamp", "min_output", "max_output")
        ),
        ("ki", 1e4),
    ],
)
def test_gains_up_to_a_bound_are_taken_and_larger_ones_refused(loop: str, field: str, most: float) -> None:
    factory = default_gains(CATALOGUE["X5-9"], 3)

    def check(value: float) -> None:
        changed = getattr(factory, loop).model_copy(update={field: value})
        check_gains(factory.model_copy(update={loop: changed}))

    check(most)
    signs = (1.0,) if field in ("punch", "i_clamp") else (1.0, -1.0)
    for sign in signs:
        check(sign * most)
        with pytest.raises(WireError) as error:
            check(sign * 1.001 * most)
        assert error.value.reason is Refusal.LIMIT
        none = ", or inf for no limit" if field in LIMITS else ""
        assert error.value.detail == (
            f"{field} {sign * 1.001 * most:g} of the {loop} loop; possible are -{most:g} .. {most:g}{none}"
        )
        # An infinite limit is none.
        unlimited = for_message(sign * math.inf)
        assert from_message(unlimited) == sign * math.inf
        if field in LIMITS:
            check(unlimited)
        else:
            with pytest.raises(WireError):
                check(unlimited)


@pytest.mark.parametrize("value", [0.0, -1.5, 1e3, 0.999 * UNLIMITED])
def test_finite_gains_are_the_same_in_messages_files_and_modules(value: float) -> None:
    assert for_message(value) == from_message(value) == value


def test_limits_are_those_of_the_type() -> None:
    limits = catalogue_limits(CATALOGUE["SEA-snake"])
    assert (limits.min_position_rad, limits.max_position_rad) == (-1.5708, 1.5708)
    assert (limits.max_speed_rad_s, limits.max_effort_nm) == (3.351, 7.0)
    free = catalogue_limits(CATALOGUE["X5-1"])
    assert (free.min_position_rad, free.max_position_rad) == (None, None)
