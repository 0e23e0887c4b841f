"""Module clocks mapped to one time base."""
