"""The contract to the modules, the loops inside simulated ones, and the client of the physics bus."""
