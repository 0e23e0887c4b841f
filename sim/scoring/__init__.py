"""Comparing a result with the simulator's truth."""
