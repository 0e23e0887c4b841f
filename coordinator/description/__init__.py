"""Robot descriptions: URDF in and out, HRDF, Denavit-Hartenberg, product of exponentials."""
