"""The thesis' experiments on simulated modules."""
