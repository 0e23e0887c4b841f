"""Kinematics of the robot: forward model, topology, and the chain from what the IMUs saw."""
