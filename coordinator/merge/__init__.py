"""Combining the information of several runs about the same modules."""
