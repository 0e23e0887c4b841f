import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from coordinator.viewer.scene import entity_paths
from coordinator.viewer.screenshot import ScreenshotFailed, screenshot, with_active_tab
from coordinator.viewer.targets import ViewerTargets
from coordinator.viewer.viewer import Viewer
from module_agent.model.chain import Chain
from module_agent.model.errors import UsageError

BLUEPRINT = {
    "/container/1": {
        "ContainerBlueprint": {
            "container_kind": "Tabs",
            "contents": ["container/2", "/container/3"],
            "active_tab": "container/2",
        }
    },
    "/container/2": {"ContainerBlueprint": {"display_name": "IMU", "contents": "view/1"}},
    "/container/3": {"ContainerBlueprint": {"display_name": "Network", "contents": ["view/2"]}},
    "/view/1": {"ViewBlueprint": {"display_name": "Network"}},
}


def test_the_tab_of_a_name_comes_to_the_front_and_all_else_stays() -> None:
    turned = with_active_tab(BLUEPRINT, "Network")
    assert turned["/container/1"]["ContainerBlueprint"]["active_tab"] == "container/3"
    assert {key: turned[key] for key in BLUEPRINT if key != "/container/1"} == {
        key: BLUEPRINT[key] for key in BLUEPRINT if key != "/container/1"
    }


def test_a_layout_without_that_tab_is_refused() -> None:
    with pytest.raises(ScreenshotFailed, match="no tab 'Dynamics'"):
        with_active_tab(BLUEPRINT, "Dynamics")


def test_a_tab_or_recording_that_does_not_exist_is_reported_before_a_viewer_starts(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="'Kinematics'; there are Identification"):
        screenshot(tmp_path / "run.rrd", tmp_path / "run.png", tab="Kinematics")
    with pytest.raises(FileNotFoundError, match=r"run\.rrd"):
        screenshot(tmp_path / "run.rrd", tmp_path / "run.png")
    (tmp_path / "run.rrd").write_text("a text")
    with pytest.raises(UsageError, match="not a Rerun recording"):
        screenshot(tmp_path / "run.rrd", tmp_path / "run.png")


@pytest.mark.integration
def test_without_software_vulkan_the_packages_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, str(tmp_path / "none.json"))
    Viewer("arm", "r", ViewerTargets(rrd=tmp_path / "run.rrd")).close()
    with pytest.raises(ScreenshotFailed, match="apt-get install mesa-vulkan-drivers libvulkan1"):
        screenshot(tmp_path / "run.rrd", tmp_path / "run.png")


def drawn(tmp_path: Path, name: str, arm: Chain, types: dict[str, str], known: bool) -> int:
    """Return how many pixels have the estimate's orange."""
    file, png = tmp_path / f"{name}.rrd", tmp_path / f"{name}.png"
    viewer = Viewer("arm", name, ViewerTargets(rrd=file))
    viewer.modules(arm.serials, types)
    viewer.phase(0, "discover")
    if known:
        viewer.chain(10**9, arm)
    viewer.phase(2 * 10**9, "done")
    viewer.close()
    try:
        screenshot(file, png, tab="Network", size=(900, 600))
    except ScreenshotFailed as failure:
        if "mesa-vulkan-drivers" in str(failure):
            pytest.skip("no software Vulkan on this machine")
        raise
    pixels = np.asarray(Image.open(io.BytesIO(png.read_bytes())).convert("HSV"), dtype=int)
    # Below the title bar, which has orange warnings of its own.
    hue, saturation, value = np.moveaxis(pixels[60:], -1, 0)
    red, green, blue, _ = entity_paths.ESTIMATE_COLOUR
    orange = Image.new("RGB", (1, 1), (red, green, blue)).convert("HSV").getpixel((0, 0))
    assert isinstance(orange, tuple)
    return int(((abs(hue - orange[0]) < 8) & (saturation > 150) & (value > 90)).sum())


@pytest.mark.integration
def test_a_picture_shows_the_identified_robot_and_nothing_before_it(
    tmp_path: Path, arm: Chain, types: dict[str, str]
) -> None:
    assert drawn(tmp_path, "known", arm, types, known=True) > 200
    assert drawn(tmp_path, "unknown", arm, types, known=False) == 0
