"""Which module is mounted on which, and which motion would tell."""
