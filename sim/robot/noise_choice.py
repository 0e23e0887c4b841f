"""A noise profile as chosen on the command line, with effects switched on and off in it."""

from typing import NamedTuple

from sim.imperfections.noise_profile import NoiseProfile, noise_profile, switched
from sim.robot.robot_file import Robot


class NoiseChoice(NamedTuple):
    """A profile's name (None: the robot's own) and the effects switched on and off in it."""

    profile: str | None = None
    on: tuple[str, ...] = ()
    off: tuple[str, ...] = ()

    def of(self, robot: Robot) -> NoiseProfile:
        """Return the chosen profile for a robot.

        Raises:
            UsageError: unknown profile or effect, or an effect is switched both on and off.
        """
        return switched(noise_profile(self.profile or robot.noise), self.on, self.off)

    @property
    def arguments(self) -> tuple[str, ...]:
        """The same choice as arguments for another program."""
        arguments = [] if self.profile is None else ["--noise", self.profile]
        arguments += [argument for name in self.on for argument in ("--with", name)]
        arguments += [argument for name in self.off for argument in ("--without", name)]
        return tuple(arguments)
