"""One file per benchmark case."""
