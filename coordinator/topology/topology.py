"""The tree of modules from observations of which IMU moved with which joint.

The joints that move a module's IMU are the ones between it and the base. So the joints that move it, its own
apart, are its ancestors; the parent is the ancestor that itself has the most ancestors. A module that moves
with its own joint is mounted reversed: by its output, so that the housing turns.

Observations are weighted by their log-odds (docs/theory.md, "Topology"); those that contradict the likeliest
forest, or leave it in doubt, are named.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from coordinator.topology.forest_likelihood import Parents, ancestors, edge_log_odds, likeliest_forest, rivals
from coordinator.topology.motion_evidence import carried_log_odds
from module_agent.model.chain import BASE, Array
from module_agent.model.errors import DataError

# Answers with lower log-odds than this are checked by another motion: 1 in 100 may be wrong.
DOUBTFUL_BELOW = float(np.log(99.0))
# Answers with lower log-odds than this are rejected: one in four would be wrong.
UNBELIEVABLE_BELOW = float(np.log(3.0))
# An observation with higher log-odds than this that does not fit is a contradiction and is not outvoted.
CONTRADICTS_ABOVE = float(np.log(19.0))


class MotionObservation(NamedTuple):
    """What one module measured of one joint's motion.

    moved: whether its IMU was carried along.
    rate_ratio: size of the gyro's answer to the joint's rate, 1 if carried, 0 if not.
    axis: (3,) direction in the IMU's frame about which it turned when the joint's position grew, if it did.
    sigma: one standard deviation of the ratio, systematic errors included. give: how much other joints moved
        along (see `motion_evidence`).
    summed_log_odds: of several motions together, of which this is the clearest; see `combined_observation`.
    """

    moved: bool
    rate_ratio: float
    axis: Array | None = None
    sigma: float = 0.1
    give: float = 0.0
    summed_log_odds: float | None = None

    @property
    def log_odds(self) -> float:
        """Log-odds that the IMU was carried."""
        if self.summed_log_odds is not None:
            return self.summed_log_odds
        size = abs(carried_log_odds(self.rate_ratio, self.sigma))
        return size if self.moved else -size


def combined_observation(motions: Sequence[MotionObservation]) -> MotionObservation:
    """Combine one module's observations of several motions of one joint: the log-odds add up.

    One outlier is outvoted by two good observations, where an average would fit neither.

    Raises:
        DataError: no motion.
    """
    if not motions:
        raise DataError("no motion was seen")
    total = sum(seen.log_odds for seen in motions)
    agreeing = [seen for seen in motions if seen.moved == (total > 0.0)] or list(motions)
    clearest = max(agreeing, key=lambda seen: abs(seen.log_odds))
    return clearest._replace(moved=total > 0.0, summed_log_odds=total)


class Doubt(NamedTuple):
    """An uncertain answer, its log-odds, and the least certain of the observations that would settle it.

    log_odds: that the answer in the topology is right; for a contradiction, that the observation is wrong.
    joint, observer: the observation to repeat.
    """

    kind: Literal["parent", "mounting", "contradiction"]
    module: str
    log_odds: float
    joint: str
    observer: str
    text: str


class Topology(NamedTuple):
    """A forest of modules, parents before children: by depth, then by serial.

    parent: index of the parent module, -1 on the base. reversed: mounted by the output.
    confidence: the probability that the least certain of all these answers is right.
    parent_log_odds, reversed_log_odds: log-odds of every answer, against all that could be instead; 0 is a
        toss-up, and so is the mounting of a module whose joint did not move. Empty if they were not
        computed, as for a topology that was known beforehand.
    unmoved: modules whose joints did not move. What they carry stands in the forest on their parents.
    doubts: what another motion should settle, the least certain first.
    """

    serials: tuple[str, ...]
    parent: tuple[int, ...]
    reversed: tuple[bool, ...]
    confidence: float
    parent_log_odds: tuple[float, ...] = ()
    reversed_log_odds: tuple[float, ...] = ()
    unmoved: tuple[str, ...] = ()
    doubts: tuple[Doubt, ...] = ()

    def caveat(self, k: int) -> str:
        """Return a phrase about what is uncertain of the module with this index; empty if nothing is."""
        if self.serials[k] in self.unmoved:
            return ", its joint did not move: mounting and what it carries unknown"
        if not self.parent_log_odds:
            return ""
        least = min(self.parent_log_odds[k], self.reversed_log_odds[k])
        return f", {_chance(least)} sure" if least < DOUBTFUL_BELOW else ""


class TopologyError(DataError):
    """The observations describe no tree; `serials` are the modules that contradict each other."""

    def __init__(self, message: str, serials: tuple[str, ...]):
        super().__init__(message)
        self.serials = serials


Observations = Mapping[tuple[str, str], MotionObservation]


def find_topology(observations: Observations, unmoved: Collection[str] = ()) -> Topology:
    """Derive the tree from observations {(joint, observer): MotionObservation}.

    Args:
        observations: of all pairs; a few may be missing where the others make up for them.
        unmoved: modules whose joints did not move, of which therefore nothing was seen.

    Raises:
        TopologyError: too many observations are missing, they contradict each other beyond noise, or they
            leave open how a module is mounted; with the serials.
    """
    topology = likely_topology(observations, unmoved)
    serials = list(topology.serials)
    _check_reversed(serials, observations)
    wrong = [d for d in topology.doubts if d.kind == "contradiction" and d.log_odds < -CONTRADICTS_ABOVE]
    if wrong:
        pair = (wrong[0].joint, wrong[0].observer)
        reason, pairs = _impossible(serials, observations, pair)
        involved = dict.fromkeys(serial for one in (pair, *pairs) for serial in one)
        raise TopologyError(
            f"{reason and reason + ': no tree does that. '}{wrong[0].text}; an IMU or an encoder that was "
            "exchanged with another's looks like this",
            tuple(involved),
        )
    open_ = [d for d in topology.doubts if d.kind != "contradiction" and d.log_odds < UNBELIEVABLE_BELOW]
    if open_:
        raise TopologyError(open_[0].text, tuple(dict.fromkeys((open_[0].module, open_[0].joint))))
    return topology


def likely_topology(observations: Observations, unmoved: Collection[str] = ()) -> Topology:
    """Derive the likeliest tree, however likely it is; `find_topology` is what to believe.

    Raises:
        TopologyError: a module has no observations, or its joint has none and it is not `unmoved`; or there
            are none at all.
    """
    serials = sorted({serial for pair in observations for serial in pair} | set(unmoved))
    if not serials:
        raise TopologyError("no module observed any motion: the topology cannot be identified", ())
    _check_complete(serials, observations, unmoved)
    # (n, n) log-odds that joint i carries the IMU of module k, 0 for what was not seen.
    seen = [[observations.get((joint, observer)) for observer in serials] for joint in serials]
    odds = np.array([[one.log_odds if one is not None else 0.0 for one in row] for row in seen])
    leaves = frozenset(serials.index(s) for s in unmoved)
    parent = likeliest_forest(odds, leaves)
    others = rivals(parent, odds, leaves)
    case = _Case(serials, observations, odds, parent, others, edge_log_odds(parent, others))
    return _described(case, unmoved)


class _Case(NamedTuple):
    """A forest in the order of `serials`, the observations that it explains, and its rivals."""

    serials: list[str]
    observations: Observations
    odds: Array
    parent: Parents
    others: dict[Parents, float]
    edge_odds: Array


def _described(case: _Case, unmoved: Collection[str]) -> Topology:
    depth = ancestors(case.parent).sum(axis=0)
    order = sorted(range(len(case.serials)), key=lambda k: (depth[k], case.serials[k]))
    index = {k: n for n, k in enumerate(order)} | {BASE: BASE}
    turned = np.diag(case.odds)
    moved = [k for k in order if case.serials[k] not in unmoved]
    least = min([*case.edge_odds, *np.abs(turned[moved])], default=np.inf)
    return Topology(
        serials=tuple(case.serials[k] for k in order),
        parent=tuple(index[case.parent[k]] for k in order),
        reversed=tuple(bool(turned[k] > 0.0) for k in order),
        confidence=float(1.0 / (1.0 + np.exp(-least))),
        parent_log_odds=tuple(float(case.edge_odds[k]) for k in order),
        reversed_log_odds=tuple(float(abs(turned[k])) for k in order),
        unmoved=tuple(sorted(unmoved)),
        doubts=tuple(sorted(_doubts(case, unmoved), key=lambda d: d.log_odds)),
    )


def _doubts(case: _Case, unmoved: Collection[str]) -> Iterator[Doubt]:
    for k, serial in enumerate(case.serials):
        if case.edge_odds[k] < DOUBTFUL_BELOW:
            # The least certain observation that separates the forest from the likeliest other parent.
            rival = max((r for r in case.others if r[k] != case.parent[k]), key=lambda r: case.others[r])
            apart = np.argwhere(ancestors(case.parent) != ancestors(rival))
            i, o = min(apart, key=lambda pair: abs(case.odds[tuple(pair)]))
            on, instead = (case.serials[p] if p != BASE else "the base" for p in (case.parent[k], rival[k]))
            question = f"on {on} or on {instead}"
            yield _doubt(case, "parent", k, float(case.edge_odds[k]), (i, o), question)
        if serial not in unmoved and abs(case.odds[k, k]) < DOUBTFUL_BELOW:
            yield _doubt(case, "mounting", k, float(abs(case.odds[k, k])), (k, k), "forward or reversed")
    above = ancestors(case.parent)
    for i, k in np.argwhere((case.odds > 0.0) != above):
        if i != k and (case.serials[i], case.serials[k]) in case.observations:
            yield from _outvoted(case, int(i), int(k))


def _doubt(
    case: _Case, kind: Literal["parent", "mounting"], k: int, odds: float, pair: tuple[int, int], how: str
) -> Doubt:
    serial, joint, observer = (case.serials[one] for one in (k, *pair))
    saw = _saw(case.observations, joint, observer)
    text = f"whether {serial} is mounted {how} is not certain ({_chance(odds)}): {saw}; repeat that motion"
    return Doubt(kind, serial, odds, joint, observer, text)


def _outvoted(case: _Case, i: int, k: int) -> Iterator[Doubt]:
    """Name an observation that does not fit; if it is a sure one, all those of which one must be wrong."""
    joint, observer, odds = case.serials[i], case.serials[k], float(abs(case.odds[i, k]))
    pairs = [(joint, observer)]
    if odds > CONTRADICTS_ABOVE:
        pairs += _impossible(case.serials, case.observations, (joint, observer)).pairs
    for pair in dict.fromkeys(pairs):
        text = f"{_saw(case.observations, *pair)}, which does not fit the rest; repeat that motion"
        yield Doubt("contradiction", pair[1], -odds, *pair, text)


def _saw(observations: Observations, joint: str, observer: str) -> str:
    seen = observations.get((joint, observer))
    if seen is None:
        return f"{observer} saw nothing of joint {joint}"
    return f"{observer} saw joint {joint} with a rate ratio of {seen.rate_ratio:.2f} +- {seen.sigma:.2f}"


def _chance(log_odds: float) -> str:
    return f"{100.0 / (1.0 + np.exp(-log_odds)):.1f} %"


class _Contradiction(NamedTuple):
    text: str
    pairs: tuple[tuple[str, str], ...]  # the observations that cannot all be true


def _check_complete(serials: list[str], observations: Observations, unmoved: Collection[str]) -> None:
    """Raise a TopologyError that names a module that never answered, not each of its missing pairs."""
    joints, observers = {i for i, _ in observations}, {k for _, k in observations}
    silent = [k for k in serials if k not in observers]
    unseen = [i for i in serials if i not in joints and i not in unmoved]
    parts = [f"module {k} reported on no joint" for k in silent]
    parts += [f"no module reported on joint {i}" for i in unseen]
    if parts:
        text = "; ".join(parts) + ". Every module must have watched every joint"
        raise TopologyError(text, tuple(dict.fromkeys([*silent, *unseen])))


def _contradictions(serials: list[str], movers: Mapping[str, list[str]]) -> Iterator[_Contradiction]:
    """Yield what no tree allows: the movers of a module must be a chain, each moved by all before it."""
    for k in serials:
        for i in movers[k]:
            if k in movers[i]:
                yield _Contradiction(f"{i} moves {k} and {k} moves {i}", ((i, k), (k, i)))
            for a in movers[i]:
                if a != k and a not in movers[k]:
                    text = f"{a} moves {i} and {i} moves {k}, but {a} does not move {k}"
                    yield _Contradiction(text, ((a, i), (i, k), (a, k)))
            for other in movers[k]:
                if i < other and i not in movers[other] and other not in movers[i]:
                    text = f"{i} and {other} both move {k}, but neither moves the other"
                    yield _Contradiction(text, ((i, k), (other, k), (i, other), (other, i)))


def _impossible(serials: list[str], observations: Observations, pair: tuple[str, str]) -> _Contradiction:
    """Return the first contradiction that a pair is part of; empty without one."""
    moved = {known for known, seen in observations.items() if seen.moved and known[0] != known[1]}
    movers = {k: [i for i in serials if (i, k) in moved] for k in serials}
    every = (one for one in _contradictions(serials, movers) if pair in one.pairs)
    return next(every, _Contradiction("", ()))


def _check_reversed(serials: list[str], observations: Observations) -> None:
    """Raise a TopologyError if a housing that its own joint turns does not turn about -z of its IMU."""
    for k in serials:
        seen = observations.get((k, k))
        sure = seen is not None and seen.log_odds >= CONTRADICTS_ABOVE
        if seen is not None and sure and seen.axis is not None and seen.axis[2] > -0.7:
            raise TopologyError(
                f"{k} moved with its own joint, as a reversed module does, but about "
                f"{seen.axis.round(2).tolist()} instead of -z of its IMU: check its encoder's sign, "
                "or how its IMU is mounted",
                (k,),
            )
