"""Comparing the simulated module with a real module's log."""
