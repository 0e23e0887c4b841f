"""World, agents and coordinator in one process on a virtual clock and network."""
