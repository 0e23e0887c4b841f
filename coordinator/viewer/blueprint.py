"""The blueprint: robot and step on the left, tabs on the right, with explicit lists of what is in each view.

Wildcards in the middle of a path match nothing, silently; so every view names its entities.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import rerun.blueprint as rrb

from coordinator.viewer import layout
from coordinator.viewer.topology_graph import Topology, extent

IDENTIFICATION, DYNAMICS, IMU, NETWORK = TABS = ("Identification", "Dynamics", "IMU", "Network")
LINK_LENGTH = "link_length"

# More modules than this on one page leave plots too small to read; they get further pages.
MODULES_PER_PAGE = 4
VIEWS_PER_PAGE = 3


class Estimated(NamedTuple):
    """An estimated parameter that has been logged: its name, its units and what has it."""

    name: str
    units: str
    serials: tuple[str, ...]


class Contents(NamedTuple):
    """What there is to show."""

    robot: str
    serials: tuple[str, ...] = ()
    estimated: tuple[Estimated, ...] = ()
    topology: Topology | None = None
    reach_m: float | None = None


def with_estimate(contents: Contents, name: str, serial: str, units: str) -> Contents:
    """Return the contents with this estimate among them; the units are those said first.

    A new parameter is taken to concern all modules, so that the layout changes once and not once per module.
    """
    known = {e.name: e for e in contents.estimated}
    found = known.get(name, Estimated(name, units, contents.serials))
    if serial not in found.serials:
        found = found._replace(serials=(*found.serials, serial))
    return contents._replace(estimated=tuple((known | {name: found}).values()))


def build(contents: Contents, active_tab: str = IDENTIFICATION) -> rrb.Blueprint:
    """Return the layout for the modules, estimates and topology there are.

    Raises:
        ValueError: there is no such tab.
    """
    if active_tab not in TABS:
        raise ValueError(f"no tab {active_tab!r}; there are {', '.join(TABS)}")
    tabs = (_identification(contents), _dynamics(contents), _imu(contents), _network(contents))
    return rrb.Blueprint(
        rrb.Horizontal(
            _left(contents), rrb.Tabs(*tabs, active_tab=TABS.index(active_tab)), column_shares=[2, 3]
        ),
        rrb.TimePanel(state="collapsed", timeline=layout.TIMELINE),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _left(contents: Contents) -> rrb.Vertical:
    return rrb.Vertical(
        rrb.TextDocumentView(origin=layout.PHASE_NOW, name="Step"),
        _robot(contents),
        _of_modules("Joint position [rad]", contents.serials, layout.module_path, layout.POSITION),
        row_shares=[1, 7, 3],
    )


def _robot(contents: Contents) -> rrb.Spatial3DView:
    eye = None
    if contents.reach_m is not None:
        size = max(contents.reach_m, 0.2)
        eye = rrb.EyeControls3D(
            position=[1.0 * size, -1.5 * size, 1.0 * size],
            look_target=[0.0, 0.0, 0.3 * size],
            eye_up=[0.0, 0.0, 1.0],
        )
    return rrb.Spatial3DView(
        origin="/world",
        contents=["/world/**"],
        name=f"{contents.robot}: as identified (orange links)",
        background=(24, 26, 32),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.1, stroke_width=0.6, color=(110, 115, 125, 90)),
        eye_controls=eye,
    )


def _identification(contents: Contents) -> rrb.Vertical:
    geometric = [e for e in contents.estimated if not _is_dynamic(e)]
    # The link length comes first and is announced by an empty plot, so that one knows what to wait for.
    first = [e for e in geometric if e.name == LINK_LENGTH] or [Estimated(LINK_LENGTH, "m", contents.serials)]
    plots = [_estimate(e) for e in (*first, *(e for e in geometric if e.name != LINK_LENGTH))]
    return rrb.Vertical(
        _paged(plots, VIEWS_PER_PAGE, "Estimates"),
        rrb.Horizontal(
            _topology(contents), rrb.TextLogView(origin=layout.PHASE_LOG, name="Log"), column_shares=[1, 1]
        ),
        row_shares=[3, 2],
        name=IDENTIFICATION,
    )


def _topology(contents: Contents) -> rrb.GraphView:
    bounds = None
    if contents.topology is not None:
        x_min, x_max, y_min, y_max = extent(contents.topology)
        bounds = rrb.VisualBounds2D(x_range=(x_min, x_max), y_range=(y_min, y_max))
    return rrb.GraphView(
        origin=layout.TOPOLOGY, name="Topology: who is mounted on whom", visual_bounds=bounds
    )


def _dynamics(contents: Contents) -> rrb.Vertical:
    held_out = [
        rrb.TimeSeriesView(
            origin=layout.residual_path(serial, layout.HELD_OUT),
            name=f"{serial}: held-out torque, predicted in orange [Nm]",
        )
        for serial in contents.serials
    ]
    plots = [
        _of_modules("Torque at the springs [Nm]", contents.serials, layout.module_path, layout.EFFORT),
        _of_modules(
            "Held-out torque, measured - predicted [Nm]", contents.serials, layout.residual_path, layout.ERROR
        ),
        *(_estimate(e) for e in contents.estimated if _is_dynamic(e)),
    ]
    return rrb.Vertical(
        _paged(held_out, MODULES_PER_PAGE, "Held-out torque", columns=2),
        _paged(plots, 2, "Estimates"),
        row_shares=[1, 1],
        name=DYNAMICS,
    )


def _imu(contents: Contents) -> rrb.Container:
    plots: list[rrb.View] = []
    for serial in contents.serials:
        for group, title in ((layout.GYRO, "gyro [rad/s]"), (layout.ACCEL, "specific force [m/s²]")):
            path = layout.module_path(serial, group)
            plots.append(rrb.TimeSeriesView(origin=path, name=f"{serial} {title}"))
    # No container around a single one: the viewer takes such out, and its name with it.
    return _paged(plots, 2 * MODULES_PER_PAGE, IMU, columns=2)


def _network(contents: Contents) -> rrb.Vertical:
    return rrb.Vertical(
        _of_modules("Round trip [ms]", contents.serials, layout.network_path, layout.ROUND_TRIP),
        _of_modules("Age of the newest sample [ms]", contents.serials, layout.network_path, layout.AGE),
        _of_modules("Refused commands, total", contents.serials, layout.network_path, layout.REFUSALS),
        rrb.StateTimelineView(
            origin="/modules",
            contents=[layout.module_path(serial, layout.STATE) for serial in contents.serials],
            name="Firmware state",
        ),
        name=NETWORK,
    )


def _of_modules(
    name: str, serials: Sequence[str], path: Callable[[str, str], str], group: str
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(origin="/", contents=[path(serial, group) for serial in serials], name=name)


def _estimate(estimated: Estimated) -> rrb.TimeSeriesView:
    paths = [layout.estimate_path(estimated.name, serial) for serial in estimated.serials]
    title = f"{estimated.name.replace('_', ' ')} [{estimated.units}], band: 1 sigma"
    return rrb.TimeSeriesView(origin="/", contents=paths, name=title[0].upper() + title[1:])


def _is_dynamic(estimated: Estimated) -> bool:
    # Mass, its moments, friction and springs have a unit of mass or torque in them; geometry has not.
    return "kg" in estimated.units or "Nm" in estimated.units


def _paged(views: Sequence[rrb.View], per_page: int, name: str, columns: int = 1) -> rrb.Container:
    pages = [views[i : i + per_page] for i in range(0, len(views), per_page)]
    if len(pages) <= 1:
        return rrb.Grid(*views, grid_columns=columns, name=name)
    return rrb.Tabs(
        *(
            rrb.Grid(*page, grid_columns=columns, name=f"{name} {number}")
            for number, page in enumerate(pages, start=1)
        ),
        name=name,
    )
