"""Modules and robots on a bench: driven without agents or network."""
