"""Solvers for inertial parameters and their uncertainty."""
