"""Square-root information of the module's own torques about the robot's inertia."""
