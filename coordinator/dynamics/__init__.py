"""Dynamics of the robot: regressor, identification of inertial parameters, prediction of torques."""
