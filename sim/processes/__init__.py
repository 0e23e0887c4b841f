"""Starting a world and agents as processes, and emulating links between them."""
