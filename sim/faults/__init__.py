"""Deterministic simulation of faults, judged by the truth of the plant."""
