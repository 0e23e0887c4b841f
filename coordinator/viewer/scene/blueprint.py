"""The blueprint: robot and step on the left, tabs on the right, with explicit lists of what is in each view.

Wildcards in the middle of a path match nothing, silently; so every view names its entities.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings as bindings

from coordinator.viewer.scene import entity_paths
from coordinator.viewer.scene.parameter_plot import AXIS_ANGLE, LINK_LENGTH, Parameter, Range, labelled
from coordinator.viewer.scene.robot_geometry import Ball
from coordinator.viewer.scene.topology_graph import Topology, extent

IDENTIFICATION, DYNAMICS, IMU, MOTORS, NETWORK, RESULT = TABS = (
    *("Identification", "Dynamics", "IMU"),
    *("Motors", "Network", "Result"),
)

# More on one page would make plots too small to read; the rest is on further pages.
MODULES_PER_PAGE = 4
COLUMNS_PER_PAGE = 3
# About a housing's length: margin around the joints.
HOUSING_M = 0.12
# The camera looks from there, from so many radii of the robot that it stays in the picture when it moves.
EYE_DIRECTION, EYE_DISTANCE = (0.48, -0.77, 0.42), 2.0

_WHOLE_RUN = rr.TimeRange(
    rr.TimeRangeBoundary.absolute(seconds=0), rr.TimeRangeBoundary.cursor_relative(seconds=0)
)


class Contents(NamedTuple):
    """Everything that the layout depends on.

    ball: around the robot. position_rad: the range of all joints; None leaves it to the viewer.
    """

    robot: str
    serials: tuple[str, ...] = ()
    estimated: tuple[Parameter, ...] = ()
    topology: Topology | None = None
    ball: Ball | None = None
    truth: bool = False
    position_rad: Range | None = None


def views(contents: Contents) -> Contents:
    """Return the contents without the ranges of the plots; contents that then differ need different views."""
    bare = (p._replace(ranges=tuple((serial, None) for serial, _ in p.ranges)) for p in contents.estimated)
    return contents._replace(estimated=tuple(bare))


def build(contents: Contents) -> rrb.Blueprint:
    """Return the layout for modules, estimates and topology."""
    tabs = (
        *(_identification(contents), _dynamics(contents), _imu(contents)),
        *(_motors(contents), _network(contents), _result()),
    )
    return rrb.Blueprint(
        rrb.Horizontal(_left(contents), rrb.Tabs(*tabs, active_tab=0), column_shares=[2, 3]),
        rrb.TimePanel(state="collapsed", timeline=entity_paths.TIMELINE),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def send(stream: rr.RecordingStream, blueprint: rrb.Blueprint) -> None:
    """Make a layout the active one, and the default of the recording.

    As of Rerun 0.41 `RecordingStream.send_blueprint` leaves two threads and 3 MB behind for good: the stream
    in which it builds the blueprint is held by its own memory sink. Here that stream is disconnected, so that
    `flush_and_cleanup_orphaned_recordings` releases it; that waits for live viewers, so it comes at the end.
    """
    layout = rr.RecordingStream._from_native(
        bindings.new_blueprint(entity_paths.APPLICATION_ID, make_default=False, make_thread_default=False)
    )
    layout.set_time("blueprint", sequence=0)
    blueprint._log_to_stream(layout)
    memory = layout.memory_recording()
    bindings.send_blueprint(memory.storage, make_active=True, make_default=True, recording=stream.to_native())
    layout.disconnect()


def _left(contents: Contents) -> rrb.Vertical:
    return rrb.Vertical(
        rrb.TextDocumentView(origin=entity_paths.PHASE_NOW, name="Step"),
        _robot(contents),
        _of_modules(
            "Joint position [rad]",
            contents.serials,
            entity_paths.module_path,
            entity_paths.POSITION,
            contents.position_rad,
        ),
        row_shares=[1.6, 6, 4],
    )


def _robot(contents: Contents) -> rrb.Spatial3DView:
    eye = None
    if contents.ball is not None:
        centre = np.array(contents.ball.centre_m)
        away = EYE_DISTANCE * (contents.ball.radius_m + HOUSING_M)
        eye = rrb.EyeControls3D(
            position=centre + away * np.array(EYE_DIRECTION), look_target=centre, eye_up=[0.0, 0.0, 1.0]
        )
    return rrb.Spatial3DView(
        origin="/world",
        contents=["/world/**"],
        name=f"{contents.robot}: as identified (orange links)"
        + (", truth in grey" if contents.truth else ""),
        background=(24, 26, 32),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.1, stroke_width=0.6, color=(110, 115, 125, 90)),
        eye_controls=eye,
    )


def _identification(contents: Contents) -> rrb.Vertical:
    # The links of the identified robot come before the estimates of single modules.
    first = (LINK_LENGTH, AXIS_ANGLE)
    shown = sorted(contents.estimated, key=lambda p: first.index(p.name) if p.name in first else len(first))
    # One empty plot announces the first estimate.
    announced = rrb.TimeSeriesView(
        origin="/",
        contents=[entity_paths.estimate_path(LINK_LENGTH, serial) for serial in contents.serials],
        name="Link length [m]: no estimate yet",
    )
    log = rrb.TextLogView(
        origin=entity_paths.PHASE_LOG, name="Log", columns=rrb.TextLogColumns(text_log_columns=["Body"])
    )
    return rrb.Vertical(
        _parameters(shown, contents) if shown else announced,
        rrb.Horizontal(_topology(contents), log, column_shares=[2, 3]),
        row_shares=[3, 2],
        name=IDENTIFICATION,
    )


def _parameters(parameters: Sequence[Parameter], contents: Contents) -> rrb.Container:
    """Lay out parameters by row and modules by column, on as many pages as needed."""
    name = "Estimates"
    serials = list(dict.fromkeys(serial for p in parameters for serial in p.ranges_by_serial()))
    # From the base to the tips, as far as the topology is known.
    known = contents.topology.serials if contents.topology is not None else ()
    serials.sort(key=lambda serial: known.index(serial) if serial in known else len(known))
    columns = [serials[i : i + COLUMNS_PER_PAGE] for i in range(0, len(serials), COLUMNS_PER_PAGE)]
    if len(columns) == 1:
        return _parameter_page(parameters, serials, name)
    whose = [f"{some[0]} to {some[-1]}" if len(some) > 1 else some[0] for some in columns]
    pages = [_parameter_page(parameters, some, who) for some, who in zip(columns, whose, strict=True)]
    return rrb.Tabs(*pages, name=name)


def _parameter_page(parameters: Sequence[Parameter], serials: Sequence[str], name: str) -> rrb.Container:
    shown = [[(p, serial) for serial in serials if serial in p.ranges_by_serial()] for p in parameters]
    rows = [rrb.Horizontal(*(_estimate(p, serial) for p, serial in row)) for row in shown if row]
    return rrb.Vertical(*rows, name=name)


def _estimate(parameter: Parameter, serial: str) -> rrb.View:
    axis_range = parameter.ranges_by_serial()[serial]
    return rrb.TimeSeriesView(
        origin=entity_paths.estimate_path(parameter.name, serial),
        name=f"{serial} {parameter.title()} [{parameter.units}]",
        # One time axis for all, so that the effect of a motion on each of them is visible.
        axis_x=rrb.TimeAxis(view_range=_WHOLE_RUN),
        axis_y=None if axis_range is None else rrb.ScalarAxis(range=labelled(axis_range)),
        plot_legend=rrb.PlotLegend(visible=False),
    )


def _topology(contents: Contents) -> rrb.GraphView:
    bounds = None
    if contents.topology is not None:
        x_min, x_max, y_min, y_max = extent(contents.topology)
        bounds = rrb.VisualBounds2D(x_range=(x_min, x_max), y_range=(y_min, y_max))
    return rrb.GraphView(origin=entity_paths.TOPOLOGY, name="Topology: parent → child", visual_bounds=bounds)


def _dynamics(contents: Contents) -> rrb.Vertical:
    held_out = [
        rrb.TimeSeriesView(
            origin=entity_paths.residual_path(serial, entity_paths.HELD_OUT),
            name=f"{serial} held-out torque [Nm]",
        )
        for serial in contents.serials
    ]
    of_all = rrb.Vertical(
        _of_modules(
            "Held-out torque, measured − predicted [Nm]",
            contents.serials,
            entity_paths.residual_path,
            entity_paths.ERROR,
        ),
        _of_modules(
            "Torque at the springs [Nm]", contents.serials, entity_paths.module_path, entity_paths.EFFORT
        ),
        name="All modules",
    )
    return rrb.Vertical(
        _paged(held_out, MODULES_PER_PAGE, "Held-out torque"),
        of_all,
        row_shares=[1, 1],
        name=DYNAMICS,
    )


def _imu(contents: Contents) -> rrb.Container:
    sensors = ((entity_paths.GYRO, "gyro [rad/s]"), (entity_paths.ACCEL, "specific force [m/s²]"))
    plots = [
        rrb.TimeSeriesView(origin=entity_paths.module_path(serial, group), name=f"{serial} {title}")
        for serial in contents.serials
        for group, title in sensors
    ]
    # No container around a single plot: the viewer removes such a container together with its name.
    return _paged(plots, 2 * MODULES_PER_PAGE, IMU)


def _motors(contents: Contents) -> rrb.Grid:
    plots = (
        ("PWM [-1 to 1]", entity_paths.PWM),
        ("Current [A]", entity_paths.CURRENT),
        ("Winding temperature [°C]", entity_paths.TEMPERATURE),
        ("Bus voltage [V]", entity_paths.VOLTAGE),
    )
    views = (_of_modules(name, contents.serials, entity_paths.module_path, group) for name, group in plots)
    return rrb.Grid(*views, grid_columns=2, name=MOTORS)


def _result() -> rrb.Vertical:
    # A container with a single view loses its name, and the log of the steps explains an empty table.
    return rrb.Vertical(
        rrb.TextDocumentView(origin=entity_paths.RESULT, name="Result of the run"),
        rrb.TextLogView(
            origin=entity_paths.PHASE_LOG,
            name="Steps",
            columns=rrb.TextLogColumns(text_log_columns=["Body"]),
        ),
        row_shares=[4, 1],
        name=RESULT,
    )


def _network(contents: Contents) -> rrb.Vertical:
    plots = (
        ("Round trip [ms]", entity_paths.ROUND_TRIP),
        ("Age of the newest sample [ms]", entity_paths.AGE),
        ("Refused commands, total", entity_paths.REFUSALS),
    )
    return rrb.Vertical(
        *(_of_modules(name, contents.serials, entity_paths.network_path, group) for name, group in plots),
        rrb.StateTimelineView(
            origin="/modules",
            contents=[entity_paths.module_path(serial, entity_paths.STATE) for serial in contents.serials],
            name="Firmware state",
        ),
        row_shares=[2, 2, 2, 3],
        name=NETWORK,
    )


def _of_modules(
    name: str,
    serials: Sequence[str],
    path: Callable[[str, str], str],
    group: str,
    axis_range: Range | None = None,
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=[path(serial, group) for serial in serials],
        name=name,
        axis_x=rrb.TimeAxis(view_range=_WHOLE_RUN),
        axis_y=None if axis_range is None else rrb.ScalarAxis(range=labelled(axis_range)),
    )


def _paged(views: Sequence[rrb.View], per_page: int, name: str) -> rrb.Container:
    """Lay out views in two columns, on as many pages as needed."""
    pages = [views[i : i + per_page] for i in range(0, len(views), per_page)]
    if len(pages) <= 1:
        return rrb.Grid(*views, grid_columns=2, name=name)
    grids = [rrb.Grid(*page, grid_columns=2, name=f"{name} {k}") for k, page in enumerate(pages, start=1)]
    return rrb.Tabs(*grids, name=name)
