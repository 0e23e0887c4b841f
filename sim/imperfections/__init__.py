"""How modules differ from their catalogue: effects, noise profiles, errors per module."""
