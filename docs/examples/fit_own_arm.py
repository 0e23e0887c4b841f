"""Inertia of any arm from its URDF and a log of torques: fit_own_arm.py ROBOT.urdf LOG.csv FITTED.urdf."""

import sys

from coordinator import fit_dynamics

urdf, log, fitted = sys.argv[1:]
fit = fit_dynamics(urdf, log)
fit.write_urdf(fitted)
for error in fit.report.held_out:
    print(f"{error.model}, {error.samples} samples, {error.torque}: torque error {100 * error.overall:.1f} %")
for link, body in zip(fit.robot.bodies, fit.bodies, strict=True):
    print(f"{link}: {body.mass_kg:.3f} kg, centre of mass {body.com_m} m")
