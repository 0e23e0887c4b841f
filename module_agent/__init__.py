"""What runs in every module: firmware, its published interface, its local estimate."""
