"""What is other about a robot than it was: modules that came, went or are mounted elsewhere, and what stays.

A link is kept if both its modules are there, the one still on the other and mounted the same way. Modules
that hang together by kept links are a part of the robot that is as it was known.
"""

from typing import NamedTuple

from coordinator.topology.topology import Topology
from module_agent.model.chain import BASE


class Difference(NamedTuple):
    """A robot found against a known one.

    new, gone, moved: serials that are new, not there any more, or there on another parent or otherwise
    mounted. parts: serials that hang together by kept links, with the topmost module first; a module none of
    whose links is kept is a part by itself. same_root: whether the first module is the known one.
    """

    new: tuple[str, ...]
    gone: tuple[str, ...]
    moved: tuple[str, ...]
    parts: tuple[tuple[str, ...], ...]
    same_root: bool

    @property
    def nothing(self) -> bool:
        """Whether all is as it was known."""
        return not (self.new or self.gone or self.moved)

    def words(self) -> list[str]:
        """Return what is other, in lines to read."""
        lines = [f"module {serial} is new" for serial in self.new]
        lines += [f"module {serial} is gone" for serial in self.gone]
        lines += [f"module {serial} is mounted elsewhere than it was" for serial in self.moved]
        return lines or ["all modules are mounted as they were known"]


def difference(known: Topology, found: Topology) -> Difference:
    """Compare two topologies."""
    before, after = _mounted(known), _mounted(found)
    part_of: dict[str, list[str]] = {}
    for serial in found.serials:
        parent = after[serial][0]
        kept = parent is not None and before.get(serial) == after[serial] and parent in before
        part_of[serial] = part_of[parent] if kept and parent is not None else []
        part_of[serial].append(serial)
    parts = tuple(tuple(part_of[s]) for s in found.serials if part_of[s][0] == s)
    return Difference(
        new=tuple(s for s in found.serials if s not in before),
        gone=tuple(s for s in known.serials if s not in after),
        moved=tuple(s for s in found.serials if s in before and before[s] != after[s]),
        parts=parts,
        same_root=known.serials[0] == found.serials[0],
    )


def joints_to_explore(found: Topology, other: Difference) -> tuple[str, ...]:
    """Return the joints whose motion tells the links that are not known.

    The joint below a link tells four of its six parameters; the offset along that joint's axis and the turn
    about it come from the one further up.
    """
    index = {serial: k for k, serial in enumerate(found.serials)}
    wanted = set()
    for part in other.parts:
        parent = found.parent[index[part[0]]]
        if parent != BASE:
            wanted |= {parent, found.parent[parent]} - {BASE}
    return tuple(s for s in found.serials if index[s] in wanted)


def _mounted(topology: Topology) -> dict[str, tuple[str | None, bool]]:
    names: tuple[str | None, ...] = (*topology.serials, None)
    return {
        serial: (names[parent], backwards)
        for serial, parent, backwards in zip(
            topology.serials, topology.parent, topology.reversed, strict=True
        )
    }
