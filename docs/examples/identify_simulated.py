"""A simulated robot identifies itself; its links against the truth: identify_simulated.py [ROBOT]."""

import sys

from sim import simulate

robot = sys.argv[1] if len(sys.argv) > 1 else "thesis_171_horizontal"
run = simulate(robot, noise="x5", seed=1, dynamics=False)
for link in run.identified.result.links:
    print(f"{link.parent} - {link.child}: {link.link_length_mm:.2f} +- {link.link_length_sigma_mm:.2f} mm")
for score in run.score().links:
    print(f"{score.parent} - {score.child}: error {score.link_length_error_mm:+.2f} mm")
