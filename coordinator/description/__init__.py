"""Robot descriptions: URDF in and out, SRDF, HRDF, Denavit-Hartenberg, product of exponentials."""
