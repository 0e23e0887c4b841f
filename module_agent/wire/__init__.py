"""What is said between modules and coordinator: keys, messages, bytes."""
