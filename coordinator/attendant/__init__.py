"""Keeping the model of a known robot true: what has changed is said, measured again, and replaced."""
