"""One nonlinear least-squares fit of chain, IMU errors and link compliance to all samples."""
