"""Inertial parameters of any arm from its URDF and a log of its torques."""
