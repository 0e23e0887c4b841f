"""Starting a world and agents as processes."""
