"""A network profile put between a program and its transport, in real time."""

import numpy as np

from module_agent.wire.impaired_transport import ImpairedTransport
from module_agent.wire.network_profile import profile
from module_agent.wire.timer_thread import TimerThread
from module_agent.wire.transport import Transport


def inject(transport: Transport, network: str, seed: int) -> Transport:
    """Return the transport impaired as the profile of this name says; `none` leaves it as it is.

    Raises:
        KeyError: unknown profile; the message lists the known ones.
    """
    found = profile(network)
    if found.name == "none":
        return transport
    return ImpairedTransport(transport, found, np.random.default_rng(seed), TimerThread())
