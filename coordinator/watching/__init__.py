"""Watching a known robot: what in its sensors is other than its model says, and what explains it."""
