"""Compliant links: quasi-static bending and twisting of each link under its load, at one hinge.

A tube that is clamped at one end moves its other end like a rigid bar on a hinge (pseudo-rigid-body model,
Howell, Compliant Mechanisms, 2001, section 5). The load is the moment about the hinge of all modules beyond:
their masses, by the catalogue, times their specific forces. Links resonate at ten times the motions'
frequencies and more, so the turn follows the moment at once: theta = C M, with one compliance for bending and
one for twisting to be estimated. Without it a link that gives by 1 % is estimated 0.7 % too long.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.batch_estimation.imu_jacobian import Displacements
from coordinator.batch_estimation.imu_kernel import Carried, fill_loads
from coordinator.batch_estimation.imu_prediction import (
    BodyMotion,
    LinkTurn,
    LinkTurns,
    body_motions,
    kernel_joints,
    kernel_turns,
    stacked,
)
from coordinator.batch_estimation.sensor_data import BaseMotion, SensorData
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import HINGE_SHARE, HINGE_SHARE_SIGMA
from module_agent.model.perturbation import cross
from module_agent.signals.filtering import differentiate

# Sigma of the hinge's distance from the line between the faces: tubes are centimetres off the modules' axes.
HINGE_ASIDE_SIGMA_M = 0.02
HINGE_SIGMAS = (HINGE_SHARE_SIGMA, HINGE_ASIDE_SIGMA_M, HINGE_ASIDE_SIGMA_M)


# A link that gives changes the loads itself: the second round changes the turns by a percent.
_ROUNDS = 2
# A link's own mass: that of the manufacturer's tubes, 0.2 kg of ends and 0.4 kg/m. It need not be exact: only
# the product of load and compliance is observable.
LINK_MASS_KG, LINK_MASS_KG_M = 0.2, 0.4


# No link has this direction, which is none of an axis or a diagonal; sideways is relative to it.
_NO_LINK = np.array([0.557, -0.309, 0.771])


class LinkLoad(NamedTuple):
    """The moment that turns one link, and where; root frame at q = 0.

    hinge: (3,) the place. along: (3,) unit direction of the link. length_m: of the link.
    force, moment: (3, 3, m) force [N] and moment about the hinge [Nm], their first and their second time
    derivatives, in the frame of the body that the link starts from.
    """

    hinge: Array
    along: Array
    length_m: float
    force: Array
    moment: Array

    @property
    def signals(self) -> Array:
        """Force and moment, (6, m), and below them their first and second time derivatives, (18, m)."""
        return np.concatenate([self.force, self.moment], axis=1).reshape(18, -1)

    @property
    def units(self) -> "LinkLoad":
        """Return the load of six samples of one unit of force or moment each, without derivatives."""
        return self._replace(force=np.eye(3, 6)[None], moment=np.eye(3, 6, 3)[None])

    def moved(self, shift: Array) -> "LinkLoad":
        """Return the load of a hinge that is somewhere else by (3,) metres."""
        about = self.moment - cross(np.broadcast_to(shift[:, None], self.force.shape), self.force)
        return self._replace(hinge=self.hinge + shift, moment=about)

    def turns(self, bending: float, twisting: float) -> list[LinkTurn]:
        """Return how the link turns across its direction and about it, for two compliances in rad/Nm."""
        about = np.asarray(self.along[:, None] * np.einsum("i,dim->dm", self.along, self.moment)[:, None])
        return [LinkTurn(self.hinge, bending * (self.moment - about)), LinkTurn(self.hinge, twisting * about)]

    @property
    def shifts(self) -> Array:
        """Unit shifts (3, 3) of the hinge: by the link's length along it, and by a metre to either side.

        They change little with the link's direction: estimates by one chain are used with refined ones.
        """
        aside = np.cross(_NO_LINK, self.along)
        aside /= max(float(np.linalg.norm(aside)), 1e-9)
        return np.vstack([self.length_m * self.along, aside, np.cross(self.along, aside)])


def link_loads(
    chain: Chain,
    kinds: Sequence[ModuleType],
    bodies: Sequence[BodyMotion],
    q_rad: Array,
    rate_hz: float,
    turns: LinkTurns | None = None,
) -> list[LinkLoad | None]:
    """Return the load of the link below every module; None for modules on the base.

    Args:
        chain: n joints; roughly right.
        kinds: (n,) their types, which give the masses.
        bodies: their motion, from `body_motions`, over one stretch of time without holes.
        q_rad: (m, n) joint positions.
        rate_hz: of the samples.
        turns: how the links turn, as far as it is known and contained in `bodies`: near a resonance the
            motion of compliant links is a load itself.
    """
    count, motion = len(chain.parent), stacked(bodies)
    starts, spans = np.zeros((count, 3)), np.zeros((count, 3))
    for i in chain.linked:
        start, end = link_ends(chain, kinds, i)
        starts[i], spans[i] = start, end - start
    length = np.linalg.norm(spans, axis=1)
    carried = Carried(
        own=np.array([kind.mass_kg for kind in kinds]),
        link=LINK_MASS_KG + LINK_MASS_KG_M * length,
        at=np.array([_place(chain, kinds, i, kinds[i].com_xyz) for i in range(count)]),
        middle=starts + 0.5 * spans,
        hinge=starts + HINGE_SHARE * spans,
        flipped=np.array(chain.reversed, dtype=bool),
    )
    signals = np.zeros((count, 6, len(q_rad)))
    q = np.array(q_rad, dtype=float, order="C")
    fill_loads(*kernel_joints(chain), q, carried, kernel_turns(turns, motion), motion, signals)
    loads: list[LinkLoad | None] = [None] * count
    for i in chain.linked:
        along = spans[i] / max(length[i], 1e-9)
        loads[i] = LinkLoad(carried.hinge[i], along, float(length[i]), signals[i, :3], signals[i, 3:])
    return _with_derivatives(loads, rate_hz)


def _with_derivatives(loads: Sequence[LinkLoad | None], rate_hz: float) -> list[LinkLoad | None]:
    """Return loads whose forces and moments, (3, m) so far, have their first two derivatives, too."""
    known = [load for load in loads if load is not None]
    if not known:
        return list(loads)
    # All signals at once: splines over the same instants share their factors.
    values = np.stack([part for load in known for part in (load.force, load.moment)])
    samples = values.shape[-1]
    first = differentiate(values.reshape(-1, samples).T, rate_hz)
    second = differentiate(first, rate_hz)
    series = np.stack([values, *(one.T.reshape(values.shape) for one in (first, second))], axis=1)
    each = iter(series.reshape(-1, 2, *series.shape[1:]))
    return [
        load and load._replace(**dict(zip(("force", "moment"), next(each), strict=True))) for load in loads
    ]


def joined(parts: Sequence[Sequence[LinkLoad | None]], keep_every: int = 1) -> list[LinkLoad | None]:
    """Join the loads of several stretches of time, link by link, one sample in `keep_every` of each."""
    loads: list[LinkLoad | None] = []
    for of_link in zip(*parts, strict=True):
        known = [part for part in of_link if part is not None]
        force = [part.force[..., ::keep_every] for part in known]
        moment = [part.moment[..., ::keep_every] for part in known]
        signals = known and {"force": np.concatenate(force, axis=2), "moment": np.concatenate(moment, axis=2)}
        loads.append(known[0]._replace(**signals) if signals else None)
    return loads


def link_ends(chain: Chain, kinds: Sequence[ModuleType], module: int) -> tuple[Array, Array]:
    """Return where the link below a module begins, at its parent's face, and where it ends, at its own."""
    parent = chain.parent[module]
    outputs = [kinds[k].output_xyz for k in (parent, module)]
    begins = _place(chain, kinds, parent, np.zeros(3) if chain.reversed[parent] else outputs[0])
    return begins, _place(chain, kinds, module, outputs[1] if chain.reversed[module] else np.zeros(3))


def _place(chain: Chain, kinds: Sequence[ModuleType], module: int, xyz: ArrayLike) -> Array:
    """Return where a point of a module's housing is at q = 0."""
    home = chain.imu_home[module]
    return np.asarray(home[:3, :3] @ (np.array(xyz) - np.array(kinds[module].imu_xyz)) + home[:3, 3])


class ComplianceJacobian(NamedTuple):
    """How the links move, and with them the readings of IMUs, with the links' compliances.

    sigmas: (p,) how well each compliance is known before, in `UNIT_RAD_NM`, or for hinges in shares of the
    length and in metres. carried: p displacements, by one unit each. taken: (p,) the part that the loads
    contain already, which the prior is about, too.
    """

    sigmas: Array
    carried: Displacements
    taken: Array

    @property
    def links(self) -> tuple[int, ...]:
        """The module that each compliance's link carries, (p,)."""
        return self.carried.modules


# One unit of compliance; that of a metre of light aluminium tube.
UNIT_RAD_NM = 1e-4
# The manufacturer's tubes bend by 1.2e-4 rad/Nm and twist by 3.6e-4 on 325 mm, 3.7e-4 and 11e-4 on a metre;
# links of 400 Nm/rad give 25e-4. Such a prior costs stiff robots nothing: slow and fast motions tell.
COMPLIANCE_SIGMA = 30.0


def compliance_jacobian(loads: Sequence[LinkLoad | None], samples: int) -> ComplianceJacobian:
    """Return how every link's compliance in bending and in twisting moves what it carries, m samples."""
    links = [(module, load) for module, load in enumerate(loads) if load is not None]
    maps = [_map(turn) for _, load in links for turn in load.units.turns(UNIT_RAD_NM, UNIT_RAD_NM)]
    modules = tuple(module for module, _ in links for _ in range(2))
    cause = tuple(place for place in range(len(links)) for _ in range(2))
    causes = np.array([load.signals for _, load in links]).reshape(-1, 18, samples)
    carried = Displacements(modules, (False,) * len(modules), np.array(maps).reshape(-1, 6, 6), cause, causes)
    return ComplianceJacobian(np.full(len(modules), COMPLIANCE_SIGMA), carried, np.zeros(len(modules)))


def _under(load: LinkLoad, pair: Array) -> Array:
    """Return the displacement (6, 6) by units of a load, for compliances in bending and in twisting."""
    bending, twisting = load.turns(*pair)
    return _map(bending) + _map(twisting)


def _map(turn: LinkTurn) -> Array:
    """Return the displacement (6, 6) by a turn under six units: a turn about the origin, and a shift."""
    theta = turn.theta_rad[0]
    return np.concatenate([theta, cross(np.broadcast_to(turn.hinge[:, None], theta.shape), theta)])


def hinge_slopes(
    loads: Sequence[LinkLoad | None], samples: int, compliance: Array, taken: Array | None = None
) -> ComplianceJacobian:
    """Return `compliance_jacobian` and the displacements by the places of the hinges (`LinkLoad.shifts`).

    Their size follows from the compliances (2 l,) of l links, as estimated with the former alone. taken:
    (3 l,) by how much the hinges of the loads have been moved already.
    """
    known = compliance_jacobian(loads, samples)
    links = known.links[::2]
    maps = []
    for place, module in enumerate(links):
        load = loads[module]
        assert load is not None
        units, pair = load.units, UNIT_RAD_NM * compliance[2 * place : 2 * place + 2]
        here = _under(units, pair)
        # Linear in the shift: a centimetre is small, and far from what numbers resolve.
        maps += [100.0 * (_under(units.moved(0.01 * shift), pair) - here) for shift in load.shifts]
    carried, number = known.carried, len(maps)
    return ComplianceJacobian(
        np.concatenate([known.sigmas, np.tile(HINGE_SIGMAS, len(links))]),
        carried._replace(
            modules=carried.modules + tuple(module for module in links for _ in range(3)),
            of_joint=carried.of_joint + (False,) * number,
            maps=np.concatenate([carried.maps, np.array(maps).reshape(-1, 6, 6)]),
            cause=carried.cause + tuple(place for place in range(len(links)) for _ in range(3)),
        ),
        np.concatenate([known.taken, np.zeros(number) if taken is None else taken]),
    )


def with_hinges_moved(
    loads: Sequence[Sequence[LinkLoad | None]], links: Sequence[int], moved: Array
) -> list[list[LinkLoad | None]]:
    """Return loads with the hinges of some links moved by (3 l,), in the units of `LinkLoad.shifts`."""
    by_link = dict(zip(links, moved.reshape(-1, 3), strict=True))
    return [
        [load and load.moved(by_link[module] @ load.shifts) for module, load in enumerate(part)]
        for part in loads
    ]


def turns_under(
    loads: Sequence[LinkLoad | None], links: Sequence[int], compliance: Array
) -> dict[int, list[LinkTurn]]:
    """Return how links turn under their loads, for compliances (2 l,) in bending and twisting by turns."""
    turns = {}
    for module, pair in zip(links, compliance.reshape(-1, 2), strict=True):
        load = loads[module]
        if load is not None:
            turns[module] = load.turns(*(UNIT_RAD_NM * pair))
    return turns


def estimated_turns(
    chain: Chain,
    kinds: Sequence[ModuleType],
    compliance: Array,
    joints: tuple[Array, Array, Array],
    rate_hz: float,
    base: BaseMotion | None = None,
) -> LinkTurns:
    """Return how the links of a refined robot turn while its joints move.

    Args:
        chain: n joints, l links.
        kinds: (n,) their types.
        compliance: (5 l,) of `Refinement`; of any other size if it was not estimated: nothing turns then.
        joints: positions, velocities and accelerations, (m, n) each, over one stretch of time without holes.
        rate_hz: of the samples. The turns' derivatives are less accurate at the ends of the stretch.
        base: how the base moved; None at rest.
    """
    links = list(chain.linked)
    turns: LinkTurns = {}
    if not links or len(compliance) != (2 + len(HINGE_SIGMAS)) * len(links):
        return turns
    by_load, hinges = np.split(compliance, [2 * len(links)])
    for _ in range(_ROUNDS):
        bodies = body_motions(chain, *joints, base, turns)
        loads = link_loads(chain, kinds, bodies, joints[0], rate_hz, turns)
        turns = turns_under(with_hinges_moved([loads], links, hinges)[0], links, by_load)
    return turns


def rigid(samples: int) -> ComplianceJacobian:
    """Return the empty Jacobian of rigid links."""
    none = Displacements.by_twists((), (), np.zeros((0, 18, samples)))
    return ComplianceJacobian(np.zeros(0), none, np.zeros(0))


def loads_of(
    chain: Chain,
    kinds: Sequence[ModuleType],
    parts: Sequence[SensorData],
    rate_hz: float,
    turns: Sequence[LinkTurns] | None = None,
) -> list[list[LinkLoad | None]]:
    """Return the loads over each of several stretches of time, as `link_loads` does over one."""
    loads = []
    for part, turned_links in zip(parts, turns or [{}] * len(parts), strict=True):
        bodies = body_motions(chain, *part.smooth, part.base, turned_links)
        loads.append(link_loads(chain, kinds, bodies, part.smooth[0], rate_hz, turned_links))
    return loads
