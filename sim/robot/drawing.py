"""Draw a robot at q = 0: modules, links, axes, IMUs and gravity."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import proj3d  # type: ignore[import-untyped]
from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

from module_agent.model.catalogue import CATALOGUE, ModuleType
from sim.geometry.pose import Array, pose
from sim.robot.robot_file import Robot
from sim.robot.robot_tree import RobotTree, build_tree

_AXIS, _IMU, _LINK, _GRAVITY = "#c0264b", "#101010", "#6b6b6b", "#2050b0"
_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))
_ELEVATION_DEG, _AZIMUTH_DEG = 22.0, -58.0


def draw(robot: Robot, path: Path | None = None) -> Figure:
    """Draw a robot at q = 0 and return the figure; with a path also save it (PNG, SVG or PDF by suffix).

    Raises:
        ValueError: a suffix that matplotlib cannot write.
    """
    tree = build_tree(robot)
    figure = Figure(figsize=(10.0, 7.0), dpi=120)
    FigureCanvasAgg(figure)
    axes: Any = figure.add_axes((0.03, 0.09, 0.68, 0.82), projection="3d")
    axes.set_proj_type("ortho")
    axes.view_init(elev=_ELEVATION_DEG, azim=_AZIMUTH_DEG)
    corners = _bodies(axes, tree)
    _frame(axes, corners)
    _axes_and_imus(axes, tree)
    _gravity(figure)
    _labels(figure, axes, robot, tree)
    _legend(figure, robot)
    title = f"{robot.name}: {len(tree.serials)} modules, {sum(b.mass_kg for b in tree.bodies):.2f} kg moving"
    figure.text(0.03, 0.95, title, fontsize=13, weight="bold")
    if path is not None:
        figure.savefig(path)
    return figure


def _box(kind: ModuleType, housing: Array) -> Array:
    low, high = kind.housing_min_xyz, kind.housing_max_xyz
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    return corners @ housing[:3, :3].T + housing[:3, 3]


def _bodies(axes: Any, tree: RobotTree) -> Array:
    """Draw housings and links; return all their corners, (k, 3)."""
    corners = []
    for kind, housing, backwards, way in zip(tree.types, tree.housing, tree.reversed, tree.way, strict=True):
        box = _box(kind, housing)
        faces = Poly3DCollection(
            [box[list(face)] for face in _FACES],
            facecolor=kind.colour,
            edgecolor="#303030",
            linewidth=0.6,
            alpha=0.35,
            hatch="///" if backwards else None,
        )
        axes.add_collection3d(faces)
        axes.plot(*way.T, color=_LINK, linewidth=5.0, alpha=0.8, solid_capstyle="round")
        corners += [box, way]
    base = tree.way[0][0]
    axes.plot(*base[:, None], marker="s", markersize=11, color="#303030")
    return np.vstack([*corners, base])


def _frame(axes: Any, corners: Array) -> None:
    """Set equal scales, and limits just around the robot with room for the axes' arrows."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    room = 0.06 * np.max(high - low)
    low, high = low - room, high + room
    # A flat robot still gets a box that can be seen.
    short = np.maximum(0.3 * np.max(high - low) - (high - low), 0.0) / 2
    low, high = low - short, high + short
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_xlabel("x [m]", labelpad=9.0)
    axes.set_ylabel("y [m]", labelpad=9.0)
    axes.set_zlabel("z [m]", labelpad=6.0)
    axes.set_box_aspect(high - low, zoom=0.88)
    axes.tick_params(labelsize=7)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(nbins=4))


def _axes_and_imus(axes: Any, tree: RobotTree) -> None:
    limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    length = np.clip(0.12 * np.max(np.ptp(limits, axis=1)), 0.06, 0.12)
    for i, kind in enumerate(tree.types):
        start = tree.output[i][:3, 3]
        # The direction about which the distal side turns when the joint's position grows.
        arrow = tree.output[i][:3, 2] * tree.axis_sign[i] * length
        axes.quiver(*start, *arrow, color=_AXIS, linewidth=1.8, arrow_length_ratio=0.28)
        imu = (tree.housing[i] @ pose(kind.imu_xyz))[:3, 3]
        axes.plot(*imu[:, None], marker="o", markersize=4.5, color=_IMU)


def _gravity(figure: Figure) -> None:
    # The view is upright, so gravity points straight down in the picture as well.
    figure.add_artist(
        FancyArrowPatch(
            (0.05, 0.90), (0.05, 0.80), arrowstyle="-|>", mutation_scale=16, color=_GRAVITY, linewidth=2
        )
    )
    figure.text(0.062, 0.84, "gravity", color=_GRAVITY, fontsize=10, style="italic")


def _labels(figure: Figure, axes: Any, robot: Robot, tree: RobotTree) -> None:
    """Name the modules in a column at the right, in the order of their height, each with a line to it."""
    figure.canvas.draw()
    centres = np.array([_box(k, h).mean(axis=0) for k, h in zip(tree.types, tree.housing, strict=True)])
    x, y, _ = proj3d.proj_transform(*centres.T, axes.get_proj())
    pixels = axes.transData.transform(np.column_stack([x, y]))
    spots = figure.transFigure.inverted().transform(pixels)
    heights = _spread(spots[:, 1], 0.045)
    for module, spot, height in zip(robot.modules, spots, heights, strict=True):
        text = f"{module.serial}  {module.type}" + ("  reversed" if module.mounted == "reversed" else "")
        figure.text(0.765, height, text, fontsize=9, va="center")
        figure.add_artist(
            Line2D([spot[0], 0.745, 0.76], [spot[1], height, height], color="#909090", linewidth=0.7)
        )


def _spread(wanted: Array, gap: float) -> Array:
    """Return heights near the wanted ones, in the same order, at least `gap` apart and within the figure."""
    order = np.argsort(wanted, kind="stable")
    heights = wanted[order].copy()
    for i in range(1, len(heights)):
        heights[i] = max(heights[i], heights[i - 1] + gap)
    heights -= (heights - wanted[order]).mean()
    heights -= max(0.0, heights[-1] - 0.90)
    heights += max(0.0, 0.14 - heights[0])
    spread = np.empty_like(heights)
    spread[order] = heights
    return spread


def _legend(figure: Figure, robot: Robot) -> None:
    types = [kind for kind in CATALOGUE.values() if any(m.type == kind.name for m in robot.modules)]
    handles = [Line2D([], [], color=t.colour, linewidth=7, alpha=0.5, label=t.name) for t in types]
    handles += [
        Line2D([], [], color=_AXIS, linewidth=1.8, marker=">", markersize=5, label="axis, turns to +q"),
        Line2D([], [], color=_IMU, linewidth=0, marker="o", markersize=4.5, label="IMU"),
        Line2D([], [], color=_LINK, linewidth=5, label="link"),
        Line2D([], [], color="#303030", linewidth=0, marker="s", markersize=9, label="base"),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=8)
