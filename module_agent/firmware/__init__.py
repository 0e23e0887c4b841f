"""The cyclic executive of a module: states, lease, freshness, expiry, limits."""
