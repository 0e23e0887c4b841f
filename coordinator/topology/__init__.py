"""Which module is mounted on which, and which motion settles doubts about it."""
