"""What the thesis leaves as future work (7.2), measured with it and without."""
