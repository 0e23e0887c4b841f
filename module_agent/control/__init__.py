"""PID controllers, gains and motions; pure functions of time."""
