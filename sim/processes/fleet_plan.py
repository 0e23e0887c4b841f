"""Which processes a fleet has: robots with a coordinator each, on Zenoh routers in a tree.

Agents connect to the router of their robot, coordinators to the root, as in a control room: so every row
crosses the tree. Robots are chains of equal modules that hang from a ceiling.
"""

from typing import NamedTuple

from module_agent.model.errors import UsageError
from sim.processes.launcher import default_processes
from sim.robot.robot_file import MAX_MODULES

# A router relays to at most so many others.
BRANCHES = 2


class PlannedRouter(NamedTuple):
    """A router: where it listens, and its parent's endpoint (None: it is the root)."""

    name: str
    endpoint: str
    parent: str | None


class PlannedRobot(NamedTuple):
    """A robot, the router of its agents, and how many processes those are."""

    name: str
    serials: tuple[str, ...]
    router: str
    processes: int


class FleetPlan(NamedTuple):
    """All of a fleet; the root is the first of the routers."""

    routers: tuple[PlannedRouter, ...]
    robots: tuple[PlannedRobot, ...]

    @property
    def root(self) -> str:
        """The endpoint that coordinators connect to."""
        return self.routers[0].endpoint

    @property
    def module_count(self) -> int:
        """How many modules the fleet has."""
        return sum(len(robot.serials) for robot in self.robots)


def plan_fleet(robots: int, modules: int, endpoints: tuple[str, ...], processes: int | None) -> FleetPlan:
    """Return the plan of `robots` robots of `modules` modules on one router for each endpoint.

    Args:
        endpoints: of the routers; the first is the root. Robots are shared out among the leaves of the tree.
        processes: agent processes of each robot; by default as `run` has them for one robot on one core.

    Raises:
        UsageError: a robot has more modules than a robot file may, or there are more leaves than robots.
    """
    if modules > MAX_MODULES:
        raise UsageError(f"--modules {modules}: a robot has at most {MAX_MODULES}; take more robots")
    routers = router_tree(endpoints)
    parents = {router.parent for router in routers}
    leaves = [router.endpoint for router in routers if router.endpoint not in parents]
    if len(leaves) > robots:
        raise UsageError(
            f"--routers {len(endpoints)}: {len(leaves)} of them are for robots, but there are {robots}"
        )
    each = min(modules, processes or default_processes(modules, cores=1))
    planned = tuple(
        PlannedRobot(
            f"robot{r + 1}",
            tuple(f"R{r + 1:02d}-{m + 1:02d}" for m in range(modules)),
            leaves[r % len(leaves)],
            each,
        )
        for r in range(robots)
    )
    return FleetPlan(routers, planned)


def router_tree(endpoints: tuple[str, ...]) -> tuple[PlannedRouter, ...]:
    """Return the routers as a balanced tree with `BRANCHES` children each."""
    return tuple(
        PlannedRouter(f"router{i + 1}", endpoint, endpoints[(i - 1) // BRANCHES] if i else None)
        for i, endpoint in enumerate(endpoints)
    )


def robot_file(robot: PlannedRobot) -> str:
    """Return the robot file of a chain of modules."""
    lines = [f'name = "{robot.name}"', 'network = "none"', "", "[base]", 'mount = "ceiling"']
    for parent, serial in zip(("base", *robot.serials), robot.serials, strict=False):
        lines += ["", "[[module]]", f'serial = "{serial}"', 'type = "X5-1"', f'parent = "{parent}"']
        if parent != "base":
            lines.append("link = { pose = { xyz_m = [0.0, 0.016, 0.06], rpy_deg = [90.0, 0.0, 0.0] } }")
    return "\n".join(lines) + "\n"
