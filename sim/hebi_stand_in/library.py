"""The names of hebi-py that the driver uses, over simulated modules."""

from collections.abc import Callable, Sequence

from sim.hebi_stand_in.messages import Color, GroupCommand, GroupFeedback, GroupInfo
from sim.hebi_stand_in.modules import Entry, ModuleNetwork, NetworkModule, entry_of

Await = Callable[[], bool]


class Group:
    """Modules that are commanded and read together."""

    def __init__(self, modules: Sequence[NetworkModule], await_tick: Await):
        self._modules = modules
        self._await_tick = await_tick
        self._requested = False
        self.feedback_frequency = 100.0
        self.command_lifetime = 250

    @property
    def size(self) -> int:
        """The number of modules."""
        return len(self._modules)

    def send_feedback_request(self) -> bool:
        """Ask all modules for their feedback."""
        self._requested = True
        return True

    def get_next_feedback(
        self, timeout_ms: int | None = None, reuse_fbk: GroupFeedback | None = None
    ) -> GroupFeedback | None:
        """Return the feedback of all modules; None if nothing was asked, or a module is silent."""
        if not self._requested or not self._await_tick() or any(module.silent for module in self._modules):
            return None
        self._requested = False
        feedback = GroupFeedback(self.size) if reuse_fbk is None else reuse_fbk
        for index, module in enumerate(self._modules):
            module.write_feedback(self, feedback, index)
        return feedback

    def send_command(self, group_command: GroupCommand) -> bool:
        """Send a command; it counts from the modules' next tick."""
        for index, module in enumerate(self._modules):
            module.command(self, self.command_lifetime, group_command, index)
        return True

    def send_command_with_acknowledgement(
        self, group_command: GroupCommand, timeout_ms: int | None = None
    ) -> bool:
        """Send a command; return whether all modules heard it."""
        self.send_command(group_command)
        return not any(module.silent for module in self._modules)

    def request_info(self, timeout_ms: float | None = None) -> GroupInfo | None:
        """Return names, settings and gains of all modules; None if one is silent."""
        if any(module.silent for module in self._modules):
            return None
        info = GroupInfo(self.size)
        for index, module in enumerate(self._modules):
            module.write_info(info, index)
        return info


class Lookup:
    """The modules that are seen on the network."""

    def __init__(self, modules: ModuleNetwork, await_tick: Await):
        self._modules, self._await_tick = modules, await_tick

    @property
    def entrylist(self) -> list[Entry]:
        """All modules."""
        return [entry_of(module) for module in self._modules.all if not module.silent]

    def get_group_from_names(
        self, families: list[str], names: list[str], timeout_ms: float | None = None
    ) -> Group | None:
        """Return the modules of these names, in this order; None if one is missing."""
        found = self._modules.named(families[0], names)
        return None if found is None else Group(found, self._await_tick)

    def get_group_from_family(self, family: str, timeout_ms: float | None = None) -> Group | None:
        """Return all modules of a family; None if there is none."""
        found = self._modules.named(family)
        return None if found is None else Group(found, self._await_tick)


class StandIn:
    """Stands in for the module `hebi`, see `hebi_library.Library`.

    `await_tick` returns when the modules have ticked after the call, False if they do not; by default they
    have, as in virtual time.
    """

    GroupCommand = GroupCommand
    GroupFeedback = GroupFeedback
    Color = Color

    def __init__(self, modules: ModuleNetwork, await_tick: Await = lambda: True):
        self._modules, self._await_tick = modules, await_tick

    def Lookup(self) -> Lookup:
        """Begin to look for modules."""
        return Lookup(self._modules, self._await_tick)
