"""Differences between two topologies of a robot: modules added, removed or moved, and unchanged parts.

A link is unchanged if both its modules are present and mounted on each other as before. Modules connected by
unchanged links form a part.
"""

from typing import NamedTuple

from coordinator.topology.topology import Topology
from module_agent.model.chain import BASE, Chain


class Mounting(NamedTuple):
    """What a module is mounted on, None for the base, and whether the other way round (by its output)."""

    parent: str | None
    reversed: bool


class Difference(NamedTuple):
    """Differences between a later topology and a baseline.

    new, removed: serials that were added or removed. moved: serials on another parent, or mounted the other
    way round. parts: serials connected by unchanged links, the topmost module first; a module without an
    unchanged link is a part by itself. same_root: whether the first module is the same.
    """

    new: tuple[str, ...]
    removed: tuple[str, ...]
    moved: tuple[str, ...]
    parts: tuple[tuple[str, ...], ...]
    same_root: bool

    @property
    def nothing(self) -> bool:
        """Whether there is no difference."""
        return not (self.new or self.removed or self.moved)

    def summary(self) -> list[str]:
        """Return the differences as lines of text."""
        changes = {"new": self.new, "missing": self.removed, "mounted differently": self.moved}
        lines = [f"module {serial} is {how}" for how, serials in changes.items() for serial in serials]
        return lines or ["all modules are mounted as in the baseline"]


def difference(baseline: Topology | Chain, later: Topology | Chain) -> Difference:
    """Compare two topologies, or the topologies of two chains; modules are matched by serial."""
    before, after = mountings(baseline), mountings(later)
    part_of: dict[str, list[str]] = {}
    for serial in later.serials:
        parent = after[serial].parent
        unchanged = parent is not None and before.get(serial) == after[serial] and parent in before
        part_of[serial] = part_of[parent] if unchanged and parent is not None else []
        part_of[serial].append(serial)
    parts = tuple(tuple(part_of[s]) for s in later.serials if part_of[s][0] == s)
    return Difference(
        new=tuple(s for s in later.serials if s not in before),
        removed=tuple(s for s in baseline.serials if s not in after),
        moved=tuple(s for s in later.serials if s in before and before[s] != after[s]),
        parts=parts,
        same_root=baseline.serials[0] == later.serials[0],
    )


def mountings(topology: Topology | Chain) -> dict[str, Mounting]:
    """Return how every module is mounted, by serial."""
    names: tuple[str | None, ...] = (*topology.serials, None)
    columns = zip(topology.serials, topology.parent, topology.reversed, strict=True)
    return {serial: Mounting(names[parent], backwards) for serial, parent, backwards in columns}


def joints_to_explore(topology: Topology, changes: Difference) -> tuple[str, ...]:
    """Return the joints whose motion determines the changed links.

    The joint below a link determines four of its six parameters; the offset along that joint's axis and the
    rotation about it are determined by the next joint towards the base.
    """
    index = {serial: k for k, serial in enumerate(topology.serials)}
    wanted = set()
    for part in changes.parts:
        parent = topology.parent[index[part[0]]]
        if parent != BASE:
            wanted |= {parent, topology.parent[parent]} - {BASE}
    return tuple(s for s in topology.serials if index[s] in wanted)
