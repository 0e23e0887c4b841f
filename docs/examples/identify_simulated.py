"""A simulated robot identifies itself; its links against the truth: identify_simulated.py [ROBOT]."""

import sys

from sim import simulate
from sim.scoring.chain_score import link_errors

run = simulate(
    sys.argv[1] if len(sys.argv) > 1 else "thesis_171_horizontal", noise="x5", dynamics=False, seed=1
)
chain = run.identified.kinematics.fit.chain
for link in run.identified.result.links:
    error = link_errors(chain, run.truth.chain, run.truth.chain.serials.index(link.child))
    sigma_mm = link.link_length_sigma_mm
    # Without a sigma the length is not known.
    claimed = "not known" if sigma_mm is None else f"{link.link_length_mm:.2f} +- {sigma_mm:.2f} mm"
    print(
        f"{link.parent} - {link.child}: {claimed}, off by {1e3 * error.length_m:+.2f} mm"
        if error
        else claimed
    )
