"""The contract to the module, and the client of the physics bus."""
