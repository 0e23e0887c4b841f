"""Benchmarks: what the thesis, this project and the physical limit come to on the same recorded data."""
