"""Every parameter is told what torques and prior know of it, and never more."""

import numpy as np
import pytest
from numpy.random import Generator

from coordinator.description.urdf_writer import link_homes
from coordinator.parameter_fit.base_parameters import (
    BaseParameters,
    base_parameters,
    inertial_columns,
    inertial_units,
    into_frames,
)
from coordinator.parameter_fit.identifiability import (
    Identifiability,
    base_summary,
    body_summary,
    identifiabilities,
)
from module_agent.model.chain import Array, Chain
from module_agent.model.regressor import torque_regressor


def pendulum() -> Chain:
    """Return two axes along -y, 0.35 m apart along x, gravity along -z."""
    return Chain(
        serials=("A", "B"),
        parent=(-1, 0),
        reversed=(False, False),
        axis=np.array([[0.0, -1.0, 0.0]] * 2),
        point=np.array([[0.0, 0.0, 0.0], [0.35, 0.0, 0.0]]),
        imu_home=np.tile(np.eye(4), (2, 1, 1)),
        gravity=np.array([0.0, 0.0, 9.81]),
    )


# In the links' frames: a kilogram 0.2 m out, and half a kilogram 0.1 m out but nearly balanced along y.
TRUTH = np.array(
    [
        *(1.0, 0.2, 0.01, 0.0, 0.01, 0.0, 0.0, 0.05, 0.0, 0.05),
        *(0.5, 0.05, 1e-5, 0.0, 0.01, 0.0, 0.0, 0.02, 0.0, 0.02),
    ]
)


def base_of(rng: Generator, noise_nm: float = 0.01) -> BaseParameters:
    chain = pendulum()
    q, qd, qdd = rng.uniform(-1.0, 1.0, (3, 300, 2)) * np.array([3.0, 3.0, 20.0])[:, None, None]
    rows = into_frames(torque_regressor(chain, q, qd, qdd).reshape(-1, 20), link_homes(chain))
    target = rows @ TRUTH + noise_nm * rng.normal(size=len(rows))
    return base_parameters(rows, target, inertial_columns(2), sigma=noise_nm)


def named(some: tuple[Identifiability, ...]) -> dict[str, Identifiability]:
    return {verdict.name: verdict for verdict in some}


def test_what_a_double_pendulum_shows_is_told_apart(rng: Generator) -> None:
    found = named(identifiabilities(base_of(rng), inertial_units(2)))
    assert {name for name, one in found.items() if one.kind == "identified"} == {"m1 c1y", "m2 c2x", "I2zz"}
    # Nearly balanced: known to a fraction of a gram metre, which is still more than its size.
    weak = found["m2 c2y"]
    assert weak.kind == "weak"
    assert weak.sigma is not None
    assert weak.value == pytest.approx(1e-5, abs=5.0 * weak.sigma)
    assert found["m2"].kind == "not identifiable"
    assert found["m2"].lumped_with == ("m1 c1x", "I1zz")
    assert found["m2"].summary == "not identifiable: only in combination with m1 c1x, I1zz"
    assert found["m1"].summary == "not identifiable: without effect on torques"
    assert found["m2"].value is None


def test_an_identified_parameter_has_the_digits_that_its_noise_leaves(rng: Generator) -> None:
    found = named(identifiabilities(base_of(rng), inertial_units(2)))["I2zz"]
    assert found.value is not None
    assert found.sigma is not None
    assert abs(found.value - 0.02) < 5.0 * found.sigma
    value, _, sigma, *unit = found.summary.removeprefix("identified: ").split()
    # Two digits of the deviation, as many places of the value.
    assert float(sigma) == pytest.approx(found.sigma, rel=0.05)
    assert len(value.split(".")[1]) == len(sigma.split(".")[1])
    assert unit[:2] == ["kg", "m^2"]


def test_what_only_the_prior_settles_is_weak_however_small_its_deviation(rng: Generator) -> None:
    base = base_of(rng)
    sigma = np.full(20, 10.0)
    sigma[10] = 0.001
    found = named(identifiabilities(base, inertial_units(2), TRUTH, sigma))
    assert found["m2"].kind == "weak"
    assert found["m2"].summary.startswith(
        "weak: 0.5000 +- 0.0010 kg (0.2 %) by the prior, only in combination with m1"
    )
    assert found["m1 c1x"].kind == "not identifiable"
    # Without effect stays so, whatever the prior believes.
    believed = named(identifiabilities(base, inertial_units(2), np.ones(20), np.full(20, 1e-6)))
    assert believed["m1"].kind == "not identifiable"
    assert believed["I2zz"].value == pytest.approx(0.02, abs=1e-3)


def test_more_noise_makes_weak_what_was_identified(rng: Generator) -> None:
    quiet, loud = (named(identifiabilities(base_of(rng, noise), inertial_units(2))) for noise in (0.01, 5.0))
    assert quiet["m1 c1y"].kind == "identified"
    assert loud["m1 c1y"].kind == "weak"
    for verdict in loud.values():
        if verdict.value is not None and verdict.sigma is not None:
            assert verdict.summary.endswith("may be zero") == (verdict.sigma >= abs(verdict.value))
    assert any(verdict.summary.endswith("may be zero") for verdict in loud.values())


def test_a_body_is_summed_up_in_a_line(rng: Generator) -> None:
    base = base_of(rng)
    found = identifiabilities(base, inertial_units(2))
    assert body_summary(found[:10]) == (
        "identified: m1 c1y; only in combinations: m1 c1x, I1zz; "
        "without effect: m1, m1 c1z, I1xx, I1xy, I1xz, I1yy, I1yz"
    )
    assert body_summary(found[10:]).startswith(
        "identified: m2 c2x, I2zz; weak: m2 c2y; only in combinations: m2;"
    )
    assert base_summary(base) == "6 base parameters of 20 parameters, 5 of them known within 10 %"


def test_what_does_not_fit_is_named(rng: Generator) -> None:
    base = base_of(rng)
    nothing: Array = np.zeros(3)
    with pytest.raises(ValueError, match="10 units for 20 parameters"):
        identifiabilities(base, inertial_units(1))
    with pytest.raises(ValueError, match="need their standard deviations"):
        identifiabilities(base, inertial_units(2), TRUTH)
    with pytest.raises(ValueError, match=r"\(3,\) values"):
        identifiabilities(base, inertial_units(2), nothing, nothing)
