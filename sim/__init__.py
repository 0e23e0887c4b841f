"""The simulated world in place of hardware: physics, sensors, network, launcher, experiments."""
