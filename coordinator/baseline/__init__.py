"""Checking and updating a robot that is known from an earlier run."""
