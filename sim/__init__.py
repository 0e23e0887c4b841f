"""The world in place of hardware: physics, sensors, network, launcher, score."""
