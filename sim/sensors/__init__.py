"""Simulated encoders, IMUs, torque sensors and clocks."""
