"""Who carries whom: the tree of modules from which IMU moved with which joint.

The joints that move a module's IMU are the ones between it and the base. So the joints that move it, its own
apart, are its ancestors; the parent is the ancestor that itself has the most ancestors. A module that moves
with its own joint is mounted reversed: by its output, so that the housing turns.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from coordinator.chain import Array
from coordinator.kinematics.forward import BASE

UNDECIDED = 0.5


class MotionSeen(NamedTuple):
    """What one module saw of one joint's motion.

    moved: whether its IMU was carried along.
    rate_ratio: size of the gyro's answer to the joint's rate, 1 if carried, 0 if not.
    axis: (3,) direction in the IMU's frame about which it turned when the joint's position grew, if it did.
    """

    moved: bool
    rate_ratio: float
    axis: Array | None = None
    sigma: float = 0.1
    give: float = 0.0


class Topology(NamedTuple):
    """A forest of modules, parents before children: by depth, then by serial.

    parent: index of the parent module, -1 on the base. reversed: mounted by the output.
    confidence: the smallest distance of any rate ratio from the undecided 0.5; 0.5 is the best there is.
    """

    serials: tuple[str, ...]
    parent: tuple[int, ...]
    reversed: tuple[bool, ...]
    confidence: float

    @property
    def roots(self) -> tuple[str, ...]:
        """The modules on the base."""
        return tuple(s for s, p in zip(self.serials, self.parent, strict=True) if p == BASE)


class TopologyError(ValueError):
    """The observations describe no tree; `serials` are the modules that contradict each other."""

    def __init__(self, message: str, serials: tuple[str, ...]):
        super().__init__(message)
        self.serials = serials


Observations = Mapping[tuple[str, str], MotionSeen]


def find_topology(observations: Observations) -> Topology:
    """Derive the tree from what every module saw of every joint: {(joint, observer): MotionSeen}.

    Raises:
        TopologyError: observations are missing or contradict each other, with the serials.
    """
    serials = sorted({serial for pair in observations for serial in pair})
    _check_complete(serials, observations)
    movers = {k: [i for i in serials if i != k and observations[i, k].moved] for k in serials}
    for problem in _contradictions(serials, movers):
        raise _explained(problem, observations)
    _check_reversed(serials, observations)
    ordered = sorted(serials, key=lambda k: (len(movers[k]), k))
    index = {serial: n for n, serial in enumerate(ordered)}
    return Topology(
        serials=tuple(ordered),
        parent=tuple(max((index[i] for i in movers[k]), default=BASE) for k in ordered),
        reversed=tuple(observations[k, k].moved for k in ordered),
        confidence=min((abs(o.rate_ratio - UNDECIDED) for o in observations.values()), default=UNDECIDED),
    )


class _Contradiction(NamedTuple):
    text: str
    pairs: tuple[tuple[str, str], ...]  # the observations that cannot all be true


def _check_complete(serials: list[str], observations: Observations) -> None:
    """A module that never answered is named as such, rather than with each of its missing pairs.

    Raises:
        TopologyError: a pair is missing.
    """
    missing = [(i, k) for i in serials for k in serials if (i, k) not in observations]
    if not missing:
        return
    silent = tuple(k for k in serials if all((i, k) in missing for i in serials))
    unmoved = tuple(i for i in serials if all((i, k) in missing for k in serials))
    parts = [f"module {k} reported on no joint" for k in silent]
    parts += [f"nobody reported on joint {i}" for i in unmoved]
    rest = [(i, k) for i, k in missing if k not in silent and i not in unmoved]
    parts += [f"module {k} did not report on joint {i}" for i, k in rest]
    culprits = [*silent, *unmoved, *(serial for pair in rest for serial in pair)]
    raise TopologyError(
        "; ".join(parts) + ". Every module must have watched every joint", tuple(dict.fromkeys(culprits))
    )


def _contradictions(serials: list[str], movers: Mapping[str, list[str]]) -> Iterator[_Contradiction]:
    """Yield what no tree allows: the movers of a module must be a chain, each moved by all before it."""
    for k in serials:
        for i in movers[k]:
            if k in movers[i]:
                yield _Contradiction(f"{i} moves {k} and {k} moves {i}", ((i, k), (k, i)))
            for a in movers[i]:
                if a != k and a not in movers[k]:
                    yield _Contradiction(
                        f"{a} moves {i} and {i} moves {k}, but {a} does not move {k}",
                        ((a, i), (i, k), (a, k)),
                    )
            for other in movers[k]:
                if i < other and i not in movers[other] and other not in movers[i]:
                    yield _Contradiction(
                        f"{i} and {other} both move {k}, but neither moves the other",
                        ((i, k), (other, k), (i, other), (other, i)),
                    )


def _explained(problem: _Contradiction, observations: Observations) -> TopologyError:
    joint, observer = min(problem.pairs, key=lambda pair: abs(observations[pair].rate_ratio - UNDECIDED))
    return TopologyError(
        f"{problem.text}: no tree does that. The least certain of these is what {observer} saw of joint "
        f"{joint}, rate ratio {observations[joint, observer].rate_ratio:.2f}; repeat that motion",
        tuple(dict.fromkeys(serial for pair in problem.pairs for serial in pair)),
    )


def _check_reversed(serials: list[str], observations: Observations) -> None:
    """A housing that turns about its own axis turns backwards: about -z of its IMU when the position grows.

    Raises:
        TopologyError: a module turned about something else.
    """
    for k in serials:
        seen = observations[k, k]
        if seen.moved and seen.axis is not None and seen.axis[2] > -0.7:
            raise TopologyError(
                f"{k} moved with its own joint, as a reversed module does, but about "
                f"{seen.axis.round(2).tolist()} instead of -z of its IMU: check its encoder's sign, "
                "or how its IMU is mounted",
                (k,),
            )
