"""Load a run and plot the torque of one joint, measured and predicted: plot_torque.py RUN JOINT PICTURE."""

import sys

import matplotlib.pyplot as plt

from coordinator import load_run

folder, joint, picture = sys.argv[1:]
run = load_run(folder)
signals = run.signals(joint)  # everything the module reported, on one time base
plt.plot(signals.t_s, signals.effort_nm, label="measured")
if run.held_out is not None and joint in run.held_out.serials:
    column = run.held_out.serials.index(joint)  # motions that nothing was fitted to
    plt.plot(run.held_out.t_s, run.held_out.predicted_nm[:, column], ".", markersize=1, label="predicted")
plt.xlabel("time [s]")
plt.ylabel(f"torque of {joint} [Nm]")
plt.legend()
plt.savefig(picture)
