"""One file per command of `x5-sim`."""
