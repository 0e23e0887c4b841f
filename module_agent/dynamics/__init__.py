"""What agents and coordinator compute alike of dynamics: chain, derivatives, regressor, information."""
