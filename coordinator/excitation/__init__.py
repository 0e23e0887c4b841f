"""Motions of several joints at once that tell the inertial parameters."""
