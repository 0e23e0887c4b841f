"""The part of hebi-py that the driver uses, as types; importing it is done here and nowhere else.

HEBI's own names are kept: https://docs.hebi.us documents them. The messages have many more fields than are
used; `hebi_modules` and `hebi_network` name those that are. A library with the same names stands in for
hebi-py in the simulator.
"""

import io
from collections.abc import Callable, Iterable, Sequence
from contextlib import redirect_stdout
from importlib import import_module
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from module_agent.model.errors import UsageError

HEBI = "hebi"
# It asks for numpy before version 2 and works with later ones: its dependencies would replace numpy.
INSTALL = "pip install --no-deps hebi-py==2.16.1"


class Group(Protocol):
    """Modules that are commanded and read together, see `hebi.Group`; messages are of one entry a module."""

    feedback_frequency: float
    command_lifetime: int

    @property
    def size(self) -> int:
        """The number of modules."""

    def send_feedback_request(self) -> bool:
        """Ask all modules for their feedback; what was not fetched before is dropped."""

    def get_next_feedback(self, timeout_ms: int | None = None, reuse_fbk: Any = None) -> Any:
        """Return the feedback that was asked for, None if it does not come in time."""

    def send_command(self, group_command: Any) -> bool:
        """Send a command that is not acknowledged; return whether it was sent."""

    def send_command_with_acknowledgement(self, group_command: Any, timeout_ms: int | None = None) -> bool:
        """Send a command; return whether all modules confirm it in time."""

    def request_info(self, timeout_ms: float | None = None) -> Any:
        """Return names, settings and gains of all modules, None if they do not come in time."""


class Entry(Protocol):
    """A module that is seen on the network."""

    @property
    def name(self) -> str:
        """The module's name."""

    @property
    def family(self) -> str:
        """The module's family."""

    @property
    def mac_address(self) -> Any:
        """Its hardware address."""

    @property
    def ip_address(self) -> Any:
        """Its address."""


class Lookup(Protocol):
    """The modules that are seen on the network, see `hebi.Lookup`."""

    @property
    def entrylist(self) -> Iterable[Entry | None]:
        """All that have been seen so far."""

    def get_group_from_names(
        self, families: list[str], names: list[str], timeout_ms: float | None = None
    ) -> Group | None:
        """Return the modules of these names, in this order; None if one is missing."""

    def get_group_from_family(self, family: str, timeout_ms: float | None = None) -> Group | None:
        """Return all modules of a family; None if there is none."""


class Library(Protocol):
    """The names of hebi-py that are used."""

    def Lookup(self) -> Lookup:
        """Begin to look for modules."""

    def GroupCommand(self, number_of_modules: int) -> Any:
        """Return an empty command."""

    def GroupFeedback(self, number_of_modules: int) -> Any:
        """Return feedback to be filled."""

    def Color(self, r: int, g: int, b: int, a: int = 255) -> Any:
        """Return a colour of the LED; transparent is the module's own."""


def library(name: str = HEBI) -> Library:
    """Return hebi-py, or what stands in for it by its module's name.

    Raises:
        UsageError: it is not installed; the message says how to install it.
    """
    try:
        # It prints which of its own extras are missing.
        with redirect_stdout(io.StringIO()):
            if name == HEBI:
                import hebi

                return hebi  # type: ignore[no-any-return]
            return import_module(name)
    except ImportError as error:
        raise UsageError(f"the library {name} cannot be imported ({error}); install it: {INSTALL}") from error


def told_states(feedback: Any) -> Callable[[Any, str], NDArray[np.bool_]]:
    """Return what says which modules have sent a state: called with a feedback like this one, and its name.

    hebi-py reads a state that is not there as 0, such as "M-stop pressed", and has no public name that says
    so; its messages have a bit for each field. What stands in for hebi-py sends all states.
    """
    internal = "hebi._internal.ffi"
    if not type(feedback).__module__.startswith(internal):
        return lambda answer, name: np.ones(len(getattr(answer, name)), np.bool_)
    fields = import_module(f"{internal}._message_enums").FeedbackEnumField
    first = import_module(f"{internal}._marshalling")._feedback_metadata.enum_field_bitfield_offset_

    def told(answer: Any, name: str) -> NDArray[np.bool_]:
        word, bit = divmod(first + fields[name.title().replace("_", "")].value, 32)
        return np.array([ref.message_bitfield_[word] >> bit & 1 for ref in answer._refs], np.bool_)

    return told


def log_loader() -> Callable[[str], Any]:
    """Return what opens the logs of HEBI's programs, `hebi.util.load_log`.

    Raises:
        UsageError: hebi-py is not installed.
    """
    hebi: Any = library()
    load: Callable[[str], Any] = hebi.util.load_log
    return load


def names_of(values: Sequence[str | None]) -> list[str]:
    """Return texts of an information message; "" for what a module did not tell."""
    return [value or "" for value in values]
