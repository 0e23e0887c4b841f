"""The physics of the simulated world: rigid bodies, actuators, IMUs."""
