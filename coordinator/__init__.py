"""What runs once: discovery, sequencing, chain model, regressor, estimates, viewer, files."""
