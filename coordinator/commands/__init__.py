"""One file per command of `x5-coordinator`."""
