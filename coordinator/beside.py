"""Who may add to what the viewer shows of a run: somebody who knows more of the robot than the run does."""

from typing import Protocol

from coordinator.kinematics.null_space import Unresolved
from coordinator.viewer.viewer import Viewer
from module_agent.dynamics.chain import Chain


class Beside(Protocol):
    """Draws beside what is identified: the run hands out its viewer and what it shows, and takes nothing."""

    def met(self, viewer: Viewer, t_ns: int) -> None:
        """The viewer knows all modules; `t_ns` is its time."""
        ...

    def chain(self, viewer: Viewer, t_ns: int, chain: Chain, unresolved: tuple[Unresolved, ...]) -> None:
        """The viewer is about to show a chain, of some modules or all; so far `unresolved` is not known."""
        ...
