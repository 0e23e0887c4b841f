import pytest

from module_agent.control.gains import default_gains
from module_agent.model.catalogue import CATALOGUE, ModuleType, UnknownModuleType, module_type

# The housing of the X5 reaches from the least to the greatest corner [m].
LEAST, GREATEST = (-0.0731, -0.0365, 0.0), (0.0365, 0.0365, 0.031)
X5 = [kind for name, kind in CATALOGUE.items() if name.startswith("X5")]


@pytest.mark.parametrize("kind", X5, ids=lambda kind: kind.name)
def test_the_imu_of_an_x5_sits_inside_its_housing(kind: ModuleType) -> None:
    assert all(low < at < high for low, at, high in zip(LEAST, kind.imu_xyz, GREATEST, strict=True))


@pytest.mark.parametrize("name", ["X5-1", "X5-4", "X5-9"])
def test_an_older_module_differs_in_the_imus_place_and_in_how_much_it_is_shaken(name: str) -> None:
    present, older = module_type(name), module_type(f"{name}-old")
    assert older.imu_xyz != present.imu_xyz
    assert older.vibration > present.vibration == 1.0
    same = {"name": present.name, "imu_xyz": present.imu_xyz, "vibration": present.vibration}
    assert older._replace(**same) == present
    for strategy in range(5):
        assert default_gains(older, strategy) == default_gains(present, strategy)


def test_a_type_that_does_not_exist_is_answered_with_those_that_do() -> None:
    with pytest.raises(UnknownModuleType, match=r"'X5-2'.*X5-1, X5-4, X5-9, X5-1-old"):
        module_type("X5-2")
