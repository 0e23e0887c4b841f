"""The states of a module and their transitions, as a table.

    idle       no lease; motor off
    armed      leased; holds the last set position
    moving     leased; a motion pattern runs on the module
    streaming  leased; follows setpoints from the network
    expired    no fresh command within the lifetime; the expiry action runs until the lease is acquired again
    stopped    a stop or the M-stop; the motor is damped, or off, until the lease is acquired again
    fault      the module protects itself (winding, sensors, position); motor off until the cause is gone and
               the lease is acquired again

A transition that is not in the table does not exist; a command that needs it is refused.
"""

from typing import Literal

from module_agent.wire.messages import State

Trigger = Literal[
    "acquire", "release", "motion", "motion_done", "setpoint", "hold", "expire", "stop", "fault"
]

_ALWAYS: dict[Trigger, State] = {"acquire": "armed", "stop": "stopped", "fault": "fault"}
_LEASED: dict[Trigger, State] = {**_ALWAYS, "release": "idle", "expire": "expired"}

TRANSITIONS: dict[State, dict[Trigger, State]] = {
    "idle": _ALWAYS,
    "armed": {**_LEASED, "motion": "moving", "setpoint": "streaming"},
    "moving": {**_LEASED, "motion_done": "armed", "hold": "armed"},
    "streaming": {**_LEASED, "motion": "moving", "setpoint": "streaming", "hold": "armed"},
    "expired": {**_ALWAYS, "release": "expired"},
    "stopped": {**_ALWAYS, "release": "stopped"},
    "fault": {"acquire": "armed", "release": "fault", "stop": "fault"},
}

# States in which the motor follows commands, whose sender must renew them within the lifetime.
COMMANDED: frozenset[State] = frozenset({"armed", "moving", "streaming"})
