"""Inertial parameters of an identified chain, from its recording."""
