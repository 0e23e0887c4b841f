"""From a recording to topology, chain, inertia and the result."""
