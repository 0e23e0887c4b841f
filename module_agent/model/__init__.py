"""What a robot is: tree, forward kinematics, perturbations, regressor, catalogue of module types; no I/O."""
