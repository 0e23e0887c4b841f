"""The states of a module and their transitions, as a table.

    idle       no lease; motor off
    armed      leased; holds the last set position
    moving     leased; a motion pattern runs on the module
    streaming  leased; follows setpoints from the network
    expired    no fresh command within the lifetime; the expiry action runs until the lease is acquired again
    stopped    a stop or the M-stop; the motor is damped until the lease is acquired again
    fault      the module protects itself (over-temperature); motor off until it has cooled and is acquired

A transition that is not in the table does not exist; a command that needs it is refused.
"""

from typing import Literal

from module_agent.wire.messages import State

Trigger = Literal["acquire", "release", "motion", "motion_done", "setpoint", "expire", "stop", "fault"]

TRANSITIONS: dict[tuple[State, Trigger], State] = {
    ("idle", "acquire"): "armed",
    ("idle", "stop"): "stopped",
    ("idle", "fault"): "fault",
    ("armed", "acquire"): "armed",
    ("armed", "release"): "idle",
    ("armed", "motion"): "moving",
    ("armed", "setpoint"): "streaming",
    ("armed", "expire"): "expired",
    ("armed", "stop"): "stopped",
    ("armed", "fault"): "fault",
    ("moving", "acquire"): "armed",
    ("moving", "release"): "idle",
    ("moving", "motion_done"): "armed",
    ("moving", "expire"): "expired",
    ("moving", "stop"): "stopped",
    ("moving", "fault"): "fault",
    ("streaming", "acquire"): "armed",
    ("streaming", "release"): "idle",
    ("streaming", "motion"): "moving",
    ("streaming", "setpoint"): "streaming",
    ("streaming", "expire"): "expired",
    ("streaming", "stop"): "stopped",
    ("streaming", "fault"): "fault",
    ("expired", "acquire"): "armed",
    ("expired", "release"): "expired",
    ("expired", "stop"): "stopped",
    ("expired", "fault"): "fault",
    ("stopped", "acquire"): "armed",
    ("stopped", "release"): "stopped",
    ("stopped", "stop"): "stopped",
    ("stopped", "fault"): "fault",
    ("fault", "acquire"): "armed",
    ("fault", "release"): "fault",
    ("fault", "stop"): "fault",
}

# States in which the motor follows commands, whose sender must renew them within the lifetime.
COMMANDED: frozenset[State] = frozenset({"armed", "moving", "streaming"})
