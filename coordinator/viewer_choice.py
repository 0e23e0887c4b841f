"""Which live viewer a person asks for."""

from typing import NamedTuple

SCHEMES = ("rerun", "rerun+http", "rerun+https")


class ViewerChoice(NamedTuple):
    """A native viewer to start, a web page to serve, or the address of a viewer that is open already."""

    spawn: bool = False
    serve: bool = False
    connect: str | None = None


def viewer_choice(text: str) -> ViewerChoice:
    """Read `none`, `spawn`, `serve` or an address.

    Raises:
        ValueError: none of these; the message says what would be right.
    """
    if text in ("none", "spawn", "serve"):
        return ViewerChoice(text == "spawn", text == "serve")
    scheme, separator, rest = text.partition("://")
    if scheme not in SCHEMES or not separator or not rest:
        raise ValueError(
            f"--viewer {text}: it must be none, spawn, serve or an address like "
            "rerun+http://127.0.0.1:9876/proxy"
        )
    return ViewerChoice(connect=text)
