"""Torques that hold a run's robot against gravity, for poses of one joint: gravity_torques.py RUN JOINT."""

import sys

import numpy as np

from coordinator import inverse_dynamics, load_run

folder, joint = sys.argv[1:]
run = load_run(folder)
assert run.phi is not None, "the run was made without dynamics"
for why in run.suspicions:
    print("not to be believed as usual:", why, file=sys.stderr)
q_rad = np.zeros((9, len(run.serials)))
q_rad[:, run.serials.index(joint)] = np.linspace(-np.pi, np.pi, 9)
still = np.zeros_like(q_rad)
torque_nm = inverse_dynamics(run.chain, run.phi, q_rad, still, still)
print("joint at [deg]  torques [Nm] of", ", ".join(run.serials))
for q, tau in zip(q_rad, torque_nm, strict=True):
    print(f"{np.degrees(q[run.serials.index(joint)]):14.0f} ", tau.round(3))
