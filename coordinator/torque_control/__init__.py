"""Gravity compensation and torque feed-forward by an identified model."""
