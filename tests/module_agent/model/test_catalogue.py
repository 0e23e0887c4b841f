import pytest

from module_agent.control.gains import default_gains
from module_agent.model.catalogue import CATALOGUE, ModuleType, UnknownModuleType, module_type

X5 = [kind for name, kind in CATALOGUE.items() if name.startswith("X5")]


@pytest.mark.parametrize("kind", X5, ids=lambda kind: kind.name)
def test_the_imu_of_an_x5_sits_inside_its_housing(kind: ModuleType) -> None:
    corners = zip(kind.housing_min_xyz, kind.imu_xyz, kind.housing_max_xyz, strict=True)
    assert all(low < at < high for low, at, high in corners)


@pytest.mark.parametrize("name", ["X5-1", "X5-4", "X5-9"])
def test_an_older_module_differs_in_the_place_and_the_vibration_of_its_imu(name: str) -> None:
    present, older = module_type(name), module_type(f"{name}-old")
    assert older.imu_xyz != present.imu_xyz
    assert older.vibration > present.vibration == 1.0
    differing = ("name", "imu_xyz", "vibration", "colour")
    assert older._replace(**{field: getattr(present, field) for field in differing}) == present
    for strategy in range(5):
        assert default_gains(older, strategy) == default_gains(present, strategy)


def test_a_type_that_does_not_exist_is_answered_with_those_that_do() -> None:
    with pytest.raises(UnknownModuleType, match=r"'X5-2'.*X5-1, X5-4, X5-9, X5-1-old"):
        module_type("X5-2")


def test_all_types_of_the_file_are_complete_and_hashable() -> None:
    assert list(CATALOGUE) == [kind.name for kind in CATALOGUE.values()]
    for kind in CATALOGUE.values():
        assert hash(kind) == hash(module_type(kind.name))
        assert all(low < high for low, high in zip(kind.housing_min_xyz, kind.housing_max_xyz, strict=True))


def test_friction_is_that_of_the_x5_1_scaled_by_the_gear_ratio() -> None:
    small, large = module_type("X5-1").motor, module_type("X5-9").motor
    assert (small.coulomb_nm, small.viscous_nm_s_rad) == (0.049, 0.011)
    assert large.coulomb_nm == pytest.approx(0.049 * 6.4, rel=1e-4)
    assert large.viscous_nm_s_rad == pytest.approx(0.011 * 6.4**2, rel=1e-4)
