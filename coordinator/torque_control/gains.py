"""Gains of gravity compensation, and of holding under it."""

from module_agent.control.gains import default_gains
from module_agent.model.catalogue import ModuleType
from module_agent.model.errors import UsageError
from module_agent.wire.messages import GainSet

# Under this strategy all three loops speak newton metres, so that a position or a velocity loop that is off
# leaves pure torque control, and the velocity loop is a damper, on the module and at its rate.
STRATEGY = 2
# Stiffness relative to the factory's position loop, which is soft under this strategy, since it has to exert
# the weight too. Measured: at 16 times, arms of four and six joints ring.
HOLDING_TIMES = 6.0
# Largest damping, and that of holding, relative to the factory's velocity loop of this strategy. Measured: at
# 10 times, an X5-1 in the wrist of an arm of six joints rings.
MAX_DAMPING_TIMES = HOLDING_TIMES


def max_damping_nm_s_rad(kind: ModuleType) -> float:
    """Return the largest damping of a module type."""
    return MAX_DAMPING_TIMES * default_gains(kind, STRATEGY).velocity.kp


def compensation_gains(kind: ModuleType, damping_nm_s_rad: float) -> GainSet:
    """Return the gains of gravity compensation: the factory's effort loop, and a damper.

    Raises:
        UsageError: the damping is negative, not finite, or more than a module of this type takes.
    """
    most = max_damping_nm_s_rad(kind)
    if not 0.0 <= damping_nm_s_rad <= most:
        raise UsageError(
            f"damping of {damping_nm_s_rad} Nm s/rad: module type {kind.name} takes 0 to {most:g} Nm s/rad"
        )
    factory = default_gains(kind, STRATEGY).model_dump()
    factory["velocity"] |= {"kp": damping_nm_s_rad, "ki": 0.0, "kd": 0.0, "feed_forward": 0.0}
    factory["position"]["kp"] *= HOLDING_TIMES
    return GainSet.model_validate(factory)


def holding_gains(kind: ModuleType) -> GainSet:
    """Return the gains of holding while gravity is compensated."""
    return compensation_gains(kind, max_damping_nm_s_rad(kind))
