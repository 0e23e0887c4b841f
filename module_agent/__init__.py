"""What runs in every module: firmware, its published interface, and its local estimates."""
