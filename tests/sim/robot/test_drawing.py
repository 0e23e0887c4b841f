from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from sim.robot.drawing import draw
from sim.robot.robot_file import load_robot


@pytest.mark.parametrize("name", ["arm6", "snake16"])
def test_a_picture_names_every_module_apart_from_the_others(name: str) -> None:
    robot = load_robot(name)
    figure = draw(robot)
    texts = {t.get_text(): t.get_position() for t in figure.texts}
    places = []
    for module in robot.modules:
        (label,) = [t for t in texts if t.startswith(module.serial + "  ")]
        assert module.type in label
        assert ("reversed" in label) == (module.mounted == "reversed")
        places.append(texts[label][1])
    assert np.diff(np.sort(places)).min() > 0.03
    assert min(places) > 0.05
    assert max(places) < 0.95


def test_a_saved_picture_shows_axes_and_modules(tmp_path: Path) -> None:
    path = tmp_path / "robot.png"
    draw(load_robot("tree_y"), path)
    pixels = imread(path)[..., :3]
    assert pixels.shape[:2] == (840, 1200)
    axis = np.abs(pixels - to_rgb("#c0264b")).max(axis=-1) < 0.05
    gravity = np.abs(pixels - to_rgb("#2050b0")).max(axis=-1) < 0.05
    assert axis.sum() > 200
    assert gravity.sum() > 200
    # At least a tenth of the picture is robot and frame.
    assert (pixels.min(axis=-1) < 0.97).mean() > 0.10


def test_a_picture_can_be_scalable(tmp_path: Path) -> None:
    path = tmp_path / "robot.svg"
    draw(load_robot("thesis_484_vertical"), path)
    assert path.read_text().count("<path") > 50
