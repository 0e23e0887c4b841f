"""Endpoints of the network: the hub listens on one, the others connect to it."""

import re
from ipaddress import ip_address

from module_agent.model.errors import UsageError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
OPEN_TO_ALL = (
    "every program that reaches that address can hear, deceive and move the robot; "
    "use --secure, see docs/security.md"
)
_WITH_PORT = ("tcp", "tls", "quic", "udp", "ws")
# Of this machine only; a serial line has another end, and a vsock reaches virtual machines.
_LOCAL = ("unixpipe", "unixsock-stream")
_OTHERS = (*_LOCAL, "serial", "vsock")
_FORM = re.compile(r"(?P<protocol>[a-z-]+)/(?P<address>[^?#]+)([?#].*)?\Z")


def check_endpoint(text: str) -> str:
    """Return an endpoint that can be listened on or connected to, such as `tcp/127.0.0.1:7447`.

    Zenoh itself treats an unknown protocol or a missing port as a hub that does not answer yet.

    Raises:
        UsageError: it can never be used; the message says what would be right.
    """
    match = _FORM.match(text)
    if match is None:
        raise UsageError(f"endpoint {text!r}: it must look like {DEFAULT_ENDPOINT}")
    protocol = match["protocol"]
    if protocol in _OTHERS:
        return text
    if protocol not in _WITH_PORT:
        known = ", ".join((*_WITH_PORT, *_OTHERS))
        raise UsageError(f"endpoint {text!r}: unknown protocol {protocol!r}, known are {known}")
    host, _, port = match["address"].rpartition(":")
    if not host or not re.fullmatch(r"[0-9]{1,5}", port) or not 0 < int(port) < 65536:
        raise UsageError(
            f"endpoint {text!r}: an address of {protocol} is HOST:PORT, with a port of 1 to 65535"
        )
    return text


def is_loopback(endpoint: str) -> bool:
    """Return whether an endpoint that `check_endpoint` takes is reached from this machine only."""
    match = _FORM.match(endpoint)
    if match is None or match["protocol"] in _OTHERS:
        return match is not None and match["protocol"] in _LOCAL
    host = match["address"].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False
