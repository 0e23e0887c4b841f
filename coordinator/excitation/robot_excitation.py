"""Excitation of a robot whose chain is identified and whose bodies have only a prior."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.dynamics.inertia_prior import module_prior
from coordinator.dynamics.pseudo_inertia import parameters
from coordinator.excitation.d_optimal import ExcitationTask, design_excitation, draw_possible
from coordinator.excitation.joint_limits import JointLimits, NoExcitation, joint_limits
from coordinator.excitation.plan import Plan
from coordinator.excitation.segment import RobotMotion, Segment
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.regressor import inverse_dynamics
from module_agent.wire.messages import Limits

# Noise of a module's torque sensor as a share of its largest torque: an encoder count of the spring's turn.
SIGMA_SHARE = 2e-3
# Of a module's own limit of position: held joints give, and a motion is refused that touches it.
END_RAD = 0.03
# The held-out motion is any that the robot may run: so many draws find one if there is one.
DRAWS = 40


class RobotModule(NamedTuple):
    """A module's type, and the limits that it reports."""

    kind: ModuleType
    limits: Limits


def robot_excitation(
    chain: Chain,
    modules: Sequence[RobotModule],
    plan: Plan,
    seed: int = 0,
    allowed: Callable[[Array], bool] | None = None,
) -> tuple[RobotMotion, ...]:
    """Return the motions to which parameters are fitted, and one more at the end that is held out.

    All stay at positions (m, n) that are `allowed`, and so do the ways from home to them and back.

    The same robot and seed have the same motions: a run that resumes goes on with those that it began with.

    Raises:
        NoExcitation: too few motions are possible, or a joint has no room at all.
        ValueError: there is not one module per joint.
    """
    rng = np.random.default_rng(seed)
    task = excitation_task(chain, modules, plan)._replace(allowed=allowed)
    chosen = design_excitation(task, rng).segments
    for _ in range(DRAWS):
        held_out = draw_possible(task, rng)
        if isinstance(held_out, Segment):
            return tuple(
                RobotMotion(
                    dict(zip(chain.serials, segment.pose_rad.tolist(), strict=True)),
                    dict(zip(chain.serials, segment.patterns, strict=True)),
                )
                for segment in (*chosen, held_out)
            )
    raise NoExcitation(f"of {DRAWS} motions none was possible that could be held out")


def excitation_task(chain: Chain, modules: Sequence[RobotModule], plan: Plan) -> ExcitationTask:
    """Return the excitation task of a robot by its modules, one per joint, and the prior of its bodies."""
    types = [module.kind for module in modules]
    phi = np.concatenate([parameters(body) for body in module_prior(chain, types)])
    home = np.full(len(types), plan.home_rad)
    effort = np.array([min(module.kind.max_effort_nm, module.limits.max_effort_nm) for module in modules])
    inertia = _own_inertia(chain, phi, home)
    return ExcitationTask(
        chain=chain,
        phi=phi,
        limits=tuple(_limits(module, about) for module, about in zip(modules, inertia, strict=True)),
        max_effort_nm=effort,
        torque_sigma_nm=SIGMA_SHARE * effort,
        home_rad=home,
        reach_rad=plan.excitation_reach_rad,
        segments=plan.excitation_motions,
        segment_s=plan.excitation_s,
        travel_speed_rad_s=plan.travel_speed_rad_s,
    )


def _limits(module: RobotModule, inertia_kg_m2: float) -> JointLimits:
    # What gravity takes is counted with the motion's own torque, in every pose.
    limits, stated = joint_limits(module.kind, 0.0, inertia_kg_m2), module.limits
    low, high = stated.min_position_rad, stated.max_position_rad
    return limits._replace(
        speed_rad_s=min(limits.speed_rad_s, stated.max_speed_rad_s),
        low_rad=limits.low_rad if low is None else max(limits.low_rad, low + END_RAD),
        high_rad=limits.high_rad if high is None else min(limits.high_rad, high - END_RAD),
    )


def _own_inertia(chain: Chain, phi: Array, home_rad: Array) -> Array:
    """Return every joint's own inertia at home (n,): the diagonal of the mass matrix."""
    count = len(home_rad)
    # A row for each joint that accelerates alone, and one in which none does.
    q = np.tile(home_rad, (count + 1, 1))
    qdd = np.vstack([np.eye(count), np.zeros(count)])
    torque = inverse_dynamics(chain, phi, q, np.zeros_like(q), qdd)
    return np.asarray(np.diagonal(torque[:count] - torque[count]))
