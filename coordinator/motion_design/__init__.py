"""Which motions tell most of a robot in the least time, within what its modules can do. Pure."""
