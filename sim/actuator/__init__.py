"""Motor, gear, spring and temperature of a module."""
