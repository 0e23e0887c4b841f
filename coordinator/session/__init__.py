"""The sequence of a run: which motion comes next."""
