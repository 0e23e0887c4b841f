"""Everything that a session received, in memory and on disk."""
