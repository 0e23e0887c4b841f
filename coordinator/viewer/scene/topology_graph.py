"""The tree of modules as a graph: parent, child and mounting direction of every module."""

from collections.abc import Mapping, Sequence
from itertools import count
from typing import TYPE_CHECKING, NamedTuple

from coordinator.viewer.scene import entity_paths
from module_agent.model.chain import BASE

if TYPE_CHECKING:
    import rerun as rr

BASE_NODE = "base"
BASE_COLOUR: entity_paths.Colour = (200, 200, 210, 255)
# In the graph's own units (points at zoom 1): room for a label of a dozen letters.
LEVEL, LEAF = 42.0, 130.0


class Topology(NamedTuple):
    """Per module its serial, the index of its parent (-1 is the base) and whether it is mounted reversed."""

    serials: tuple[str, ...]
    parent: tuple[int, ...]
    reversed: tuple[bool, ...]


def positions(topology: Topology) -> list[tuple[float, float]]:
    """Return the position of the base, then of every module: depth goes down, every leaf has its own column.

    A parent is above the middle of its children, so no two edges cross.
    """
    placed: dict[int, tuple[float, float]] = {}
    columns = count()

    def place(node: int, depth: int) -> float:
        """Place a node and all below it, and return how far across it is."""
        below = [place(k, depth + 1) for k, parent in enumerate(topology.parent) if parent == node]
        across = sum(below) / len(below) if below else float(next(columns))
        placed[node] = (LEAF * across, LEVEL * depth)
        return across

    place(BASE, 0)
    return [placed[k] for k in (BASE, *range(len(topology.serials)))]


def graph(
    topology: Topology, types: Mapping[str, str], colours: Mapping[str, entity_paths.Colour]
) -> "tuple[rr.GraphNodes, rr.GraphEdges]":
    """Draw the tree at fixed positions, which need no settling."""
    import rerun as rr

    labels = [
        " · ".join(filter(None, [serial, types.get(serial), "reversed" if reverse else ""]))
        for serial, reverse in zip(topology.serials, topology.reversed, strict=True)
    ]
    nodes = rr.GraphNodes(
        node_ids=[BASE_NODE, *topology.serials],
        labels=[BASE_NODE, *labels],
        colors=[BASE_COLOUR, *(colours[serial] for serial in topology.serials)],
        positions=positions(topology),
        show_labels=True,
        radii=8.0,
    )
    names = (*topology.serials, BASE_NODE)  # so that the index -1 is the base
    edges = rr.GraphEdges(
        edges=[
            (names[parent], serial) for parent, serial in zip(topology.parent, topology.serials, strict=True)
        ],
        graph_type="directed",
    )
    return nodes, edges


def extent(topology: Topology) -> tuple[float, float, float, float]:
    """Return the box (x_min, x_max, y_min, y_max) that shows all of the graph."""
    x, y = zip(*positions(topology), strict=True)
    return (min(x) - LEAF, max(x) + LEAF, min(y) - 0.6 * LEVEL, max(y) + 0.6 * LEVEL)


def as_topology(serials: Sequence[str], parent: Sequence[int], reverse: Sequence[bool]) -> Topology:
    """Build a topology from sequences of any type.

    Raises:
        ValueError: the sequences differ in length, or a parent does not come before its child.
    """
    if not (len(parent) == len(reverse) == len(serials)):
        raise ValueError(f"{len(serials)} serials, {len(parent)} parents, {len(reverse)} directions")
    for k, above in enumerate(parent):
        if not BASE <= above < k:
            raise ValueError(
                f"not a tree with parents before children: module {serials[k]!r} (index {k}) has parent "
                f"index {above}"
            )
    return Topology(tuple(serials), tuple(int(p) for p in parent), tuple(bool(r) for r in reverse))
