"""The live view in Rerun."""
