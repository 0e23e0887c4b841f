"""A run for other programs: tables, ROS 2 and Foxglove, on one time base."""
