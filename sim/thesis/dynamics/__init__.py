"""The thesis' inertial parameters and torque assistance on simulated modules."""
