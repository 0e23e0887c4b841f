"""Experiments on the simulator: what others have measured on real modules, done again on simulated ones."""
