"""A network profile put between a program and its transport, in real time."""

import numpy as np

from module_agent.wire.impaired_transport import ImpairedTransport
from module_agent.wire.network_profile import NetworkProfile, Receiver
from module_agent.wire.timer_thread import TimerThread
from module_agent.wire.transport import Transport


def inject(transport: Transport, network: NetworkProfile, seed: int, receiver: Receiver) -> Transport:
    """Return the transport impaired as the profile says for this receiver; a perfect path changes nothing."""
    parted = receiver == "coordinator" and network.partitions
    if network.path(receiver).is_perfect and not parted:
        return transport
    rng = np.random.default_rng(seed)
    return ImpairedTransport(transport, network, rng, TimerThread(), receiver=receiver)
