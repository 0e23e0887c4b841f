"""The estimates that a module computes from its own samples."""
