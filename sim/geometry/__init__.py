"""Poses, rigid bodies and the parts of links."""
