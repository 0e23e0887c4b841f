"""Inertia of any arm from its URDF and a log of torques: fit_own_arm.py ROBOT.urdf LOG.csv FITTED.urdf."""

import sys

from coordinator import fit_dynamics

urdf, log, fitted = sys.argv[1:]
fit = fit_dynamics(urdf, log, fitted_urdf=fitted)
for error in fit.report.held_out:
    print(f"{error.model}, {error.samples} samples, {error.torque}: torque error {100 * error.overall:.1f} %")
for body in fit.report.fit.bodies:
    print(f"{body.link}: {body.mass_kg} kg")
