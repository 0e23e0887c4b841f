"""The largest effort of every joint in every motion of a run, with pandas: effort_by_motion.py RUN."""

import sys

from coordinator import load_run

frame = load_run(sys.argv[1]).frame()
moving = frame[frame["motion_id"] > 0]
effort = moving.assign(effort_nm=moving["effort_nm"].abs()).groupby(["module", "motion_id"], observed=True)
print(effort.agg(begin_s=("t_s", "min"), end_s=("t_s", "max"), largest_nm=("effort_nm", "max")).round(3))
