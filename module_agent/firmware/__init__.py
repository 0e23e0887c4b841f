"""The pure firmware of a module: one step a tick, no clock, no socket, no file."""
