"""Where is the last module, and how surely? Poses with covariance: pose_with_covariance.py RUN."""

import sys

import numpy as np

from coordinator import forward_kinematics, load_run

run = load_run(sys.argv[1])
q_rad = np.random.default_rng(1).uniform(-1.0, 1.0, (5, len(run.serials)))
poses = forward_kinematics(run, q_rad)
assert poses.position_sigma_m is not None
for sample, q in enumerate(q_rad):
    x, y, z = 1e3 * poses.pose[sample, -1, :3, 3]
    sigma = 1e3 * poses.position_sigma_m[sample, -1]
    print(f"q = {q.round(2)} rad: {run.serials[-1]} at ({x:.1f}, {y:.1f}, {z:.1f}) mm, sigma {sigma:.2f} mm")
for item in run.result.unresolved:  # these directions are not observable and have zero variance above
    print("not observable:", item.summary)
