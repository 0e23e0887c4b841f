"""The thesis' motions, signals and lengths of a link on simulated modules."""
